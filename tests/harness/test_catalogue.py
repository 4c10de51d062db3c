"""Instances are found, or one line says what is wrong with the benchmarks folder."""

import gzip
import hashlib
import json

import pytest

from harness import catalogue
from harness.catalogue import (
    find_file,
    load_category,
    load_references,
    relative,
    select,
    sha256,
)
from harness.records import Verdict
from racecar.errors import BadInput


def test_category_in_the_order_of_its_file(benchmarks):
    b, a = benchmarks.add("b", timeout=2.5), benchmarks.add("a")
    entries = load_category(benchmarks.root, "quick")
    assert [(e.id, e.spec, e.timeout) for e in entries] == [("b", b, 2.5), ("a", a, 10.0)]
    assert entries[0].onnx == benchmarks.onnx
    assert relative(entries[0].onnx, benchmarks.root) == "../onnx/straight.onnx"
    assert relative(entries[0].spec, benchmarks.root) == "quick/json/b.json"


def test_everything_by_default(benchmarks):
    benchmarks.add("one"), benchmarks.add("two", category="other")
    assert [e.id for e in select(benchmarks.root, (), ())] == ["two", "one"]
    assert [e.id for e in select(benchmarks.root, ("quick",), ())] == ["one"]


def test_instances_by_file_and_by_id(benchmarks, tmp_path):
    spec = benchmarks.add("one", timeout=3.0)
    benchmarks.add("two")
    by_file = select(benchmarks.root, (), (str(spec),))
    assert [(e.id, e.timeout) for e in by_file] == [("one", 3.0)]
    assert select(benchmarks.root, (), ("one",)) == by_file
    (loose,) = select(None, (), (str(spec),))
    assert (loose.id, loose.category, loose.onnx) == ("one", "quick", benchmarks.onnx)
    assert loose.timeout == catalogue.DEFAULT_TIMEOUT_S
    assert len(select(benchmarks.root, ("quick",), (str(spec), "one", "two"))) == 2


def test_unknown_names(benchmarks, tmp_path):
    benchmarks.add("one")
    with pytest.raises(BadInput, match=r"category 'nope' is unknown in .*; choose one of quick"):
        select(benchmarks.root, ("nope",), ())
    (benchmarks.root / "quick" / "instances.csv").write_text("")
    with pytest.raises(BadInput, match="there is no instance to run in quick"):
        select(benchmarks.root, ("quick",), ())
    with pytest.raises(BadInput, match="instance nope: there is no such file, nor an instance"):
        select(benchmarks.root, (), ("nope",))


def test_loose_file_is_checked(benchmarks, tmp_path):
    broken = tmp_path / "broken.json"
    broken.write_text("{}")
    with pytest.raises(BadInput, match=r"broken\.json"):
        select(None, (), (str(broken),))
    spec = benchmarks.add("one")
    data = json.loads(spec.read_text())
    data["controller"]["sha256"] = "0" * 64
    data["controller"]["file"] = str(benchmarks.onnx)
    broken.write_text(json.dumps(data))
    with pytest.raises(BadInput, match="sha256"):
        select(None, (), (str(broken),))


def test_same_id_in_two_categories(benchmarks):
    benchmarks.add("one"), benchmarks.add("one", category="other")
    with pytest.raises(BadInput, match="same ID"):
        select(benchmarks.root, (), ())


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a,b\n", "line 1: 2 columns"),
        ("{row}\n\n{row},x\n", "line 3: 4 columns"),
        ("../../onnx/none.onnx,json/one.json,1\n", "line 1: there is no file .*none.onnx"),
        ("../../onnx/straight.onnx,json/none.json,1\n", "there is no file .*none.json"),
        ("../../onnx/straight.onnx,json/one.json,soon\n", "timeout 'soon'"),
        ("../../onnx/straight.onnx,json/one.json,nan\n", "timeout 'nan'"),
        ("../../onnx/straight.onnx,json/one.json,0\n", "timeout '0'"),
        ('"../../onnx/straight.onnx,json/one.json,1\n', "cannot be read"),
        ("\0,json/one.json,1\n", "."),
    ],
)
def test_broken_instances_csv(benchmarks, rows, message):
    benchmarks.add("one")
    row = "../../onnx/straight.onnx,json/one.json,1"
    (benchmarks.root / "quick" / "instances.csv").write_text(rows.format(row=row))
    with pytest.raises(BadInput, match=message):
        load_category(benchmarks.root, "quick")


def test_references(benchmarks):
    benchmarks.add("one")
    benchmarks.set_references(["a,unsat,0.02,0.03", "b,sat,,-0.1", "c,unknown,,", "d,sat,,0.1"])
    found = load_references(benchmarks.root)
    assert [r.verdict for r in found.values()] == [
        Verdict.UNSAT, Verdict.SAT, Verdict.UNKNOWN, Verdict.SAT,
    ]  # fmt: skip
    assert (found["a"].margin_lower, found["a"].margin_upper) == (0.02, 0.03)
    assert [r.proves_sat for r in found.values()] == [False, True, False, False]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the header"),
        ("instance,verdict\n", "line 1: the header"),
        ("instance,verdict,margin_lower,margin_upper\na,safe,,\n", "line 2: verdict is 'safe'"),
        ("instance,verdict,margin_lower,margin_upper\na,sat,,x\n", "line 2: a margin"),
        ("instance,verdict,margin_lower,margin_upper\na,sat\n", "line 2: 2 columns"),
    ],
)
def test_broken_reference_csv(benchmarks, text, message):
    benchmarks.add("one")
    (benchmarks.root / "quick" / "reference.csv").write_text(text)
    with pytest.raises(BadInput, match=message):
        load_references(benchmarks.root)


def test_benchmarks_folder(benchmarks, tmp_path, monkeypatch):
    benchmarks.add("one")
    monkeypatch.chdir(benchmarks.folder)
    assert catalogue.require_root(None) == benchmarks.root
    with pytest.raises(BadInput, match="none: there is no benchmarks folder"):
        catalogue.find_root(tmp_path / "none")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(catalogue.harness, "__file__", str(tmp_path / "site" / "h" / "__init__.py"))
    with pytest.raises(BadInput, match="give one with --benchmarks"):
        catalogue.require_root(None)


def test_a_packed_file_is_the_same_file(tmp_path):
    plain, packed = tmp_path / "a.vnnlib", tmp_path / "b.vnnlib.gz"
    plain.write_bytes(b"(assert)")
    packed.write_bytes(gzip.compress(b"(assert)", mtime=5))
    assert sha256(packed) == sha256(plain) == hashlib.sha256(b"(assert)").hexdigest()
    packed.write_bytes(gzip.compress(b"(assert)")[:-6])
    with pytest.raises(BadInput, match=r"b\.vnnlib\.gz: cannot be read"):
        sha256(packed)


def test_a_file_is_found_packed_or_not(tmp_path):
    (tmp_path / "a.onnx").touch()
    (tmp_path / "b.onnx.gz").touch()
    assert (
        find_file(tmp_path / "a.onnx.gz") == find_file(tmp_path / "a.onnx") == tmp_path / "a.onnx"
    )
    assert find_file(tmp_path / "b.onnx") == tmp_path / "b.onnx.gz"
    assert find_file(tmp_path / "c.onnx") is None
