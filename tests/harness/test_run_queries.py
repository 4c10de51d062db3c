"""Categories of VNN-LIB queries are run, judged, scored and submitted like all others."""

import gzip
import json

import pytest
from harness_helpers import harness
from query_helpers import linear_network, query_1, query_2, witness_1, witness_2

from harness.catalogue import in_all_versions, load_category, select
from racecar.errors import BadInput

BOX = ("(>= X_0 0.0)", "(<= X_0 1.0)", "(>= Y_0 0.5)")


@pytest.fixture
def root(tmp_path):
    """A benchmarks folder with the category ``unrolled``: plain and gzipped files."""
    benchmarks, onnx = tmp_path / "benchmarks", tmp_path / "onnx"
    (benchmarks / "unrolled").mkdir(parents=True)
    onnx.mkdir()
    (onnx / "plain.onnx").write_bytes(linear_network([[1.0]]))
    (onnx / "packed.onnx.gz").write_bytes(gzip.compress(linear_network([[1.0]])))
    rows = []
    for version, query in (("1.0", query_1), ("2.0", query_2)):
        folder = tmp_path / "vnnlib" / "unrolled" / version
        folder.mkdir(parents=True)
        (folder / "a.k1.vnnlib").write_text(query(1, 1, *BOX))
        (folder / "b.k1.vnnlib.gz").write_bytes(gzip.compress(query(1, 1, *BOX).encode()))
    for name, network in (("a", "plain"), ("b", "packed")):
        rows.append(f"../../onnx/{network}.onnx,../../vnnlib/unrolled/1.0/{name}.k1.vnnlib,5\n")
    (benchmarks / "unrolled" / "instances.csv").write_text("".join(rows))
    return benchmarks


def answers(*witnesses):
    """Return a script that writes a witness for each instance in turn."""
    names = ("a", "b")
    cases = [
        f"*/{name}.k1.vnnlib*) printf 'sat\\n%s\\n' '{text.decode()}' > \"$RESULTS\" ;;"
        for name, text in zip(names, witnesses, strict=True)
    ]
    return "case $4 in\n" + "\n".join(cases) + "\nesac"


def run(root, tool, out, *options):
    done = harness("run", "--tool", tool, "--benchmarks", root, "--out", out, "--json", *options)
    assert done.returncode == 0, done.stderr
    return {row["instance"]: row for row in map(json.loads, done.stdout.splitlines())}


def test_packed_files_are_found_by_their_plain_names(root):
    a, b = load_category(root, "unrolled")
    assert (a.id, a.onnx.name, a.spec.name) == ("a.k1", "plain.onnx", "a.k1.vnnlib")
    assert (b.id, b.onnx.name, b.spec.name) == ("b.k1", "packed.onnx.gz", "b.k1.vnnlib.gz")
    assert [e.spec.parent.name for e in in_all_versions(b)] == ["1.0", "2.0"]


def test_witnesses_are_judged_and_scored(root, make_tool, tmp_path):
    good, bad = witness_1([0.75], [0.0]), witness_1([0.25], [99.0])
    rows = run(root, make_tool(answers(good, good), name="good"), tmp_path / "good")
    for row in rows.values():
        assert row["witness_check"]["outcome"] == "correct"
        assert row["witness_check"]["violation"] == 0.25
        assert row["witness_check"]["spec_sha256"] == row["spec_sha256"]
    rows = run(root, make_tool(answers(good, bad), name="bad"), tmp_path / "bad")
    assert rows["b.k1"]["witness_check"]["outcome"] == "wrong"
    where = ("--benchmarks", root)
    done = harness("score", tmp_path / "good", tmp_path / "bad", *where, "--json")
    scores = [(r["tool"], r["score"]) for r in map(json.loads, done.stdout.splitlines())]
    assert scores[:2] == [("good", 20), ("bad", -140)]
    done = harness("score", "--explain", "b.k1", tmp_path / "bad", *where)
    assert "found wrong: the outputs miss the condition by 0.25." in done.stdout


def test_other_version_by_its_file(root, make_tool, tmp_path):
    spec = tmp_path / "vnnlib" / "unrolled" / "2.0" / "a.k1.vnnlib"
    (entry,) = select(root, [], [str(spec)])
    assert (entry.spec, entry.category, entry.timeout) == (spec, "unrolled", 5.0)
    text = witness_2([0.75], [0.0])
    tool = make_tool(answers(text, text))
    rows = run(root, tool, tmp_path / "run", "--instance", spec)
    assert rows["a.k1"]["witness_check"]["outcome"] == "correct"
    archive = tmp_path / "s.tar.gz"
    who = ("--author", "A", "--contact", "a@b.org", "--tool-version", "1")
    where = ("--benchmarks", root)
    assert harness("submit", tmp_path / "run", "-o", archive, *who, *where).returncode == 0
    done = harness("verify-submission", archive, *where)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (
        0,
        "valid: 1 results, 1 witnesses replayed",
    )


def test_versions_of_a_query_are_scored_side_by_side(root, make_tool, tmp_path):
    good = witness_1([0.75], [0.0])
    run(root, make_tool(answers(good, good), name="one"), tmp_path / "one")
    spec = tmp_path / "vnnlib" / "unrolled" / "2.0" / "a.k1.vnnlib"
    run(
        root, make_tool('echo unsat > "$RESULTS"', name="two"), tmp_path / "two", "--instance", spec
    )
    score = ("score", tmp_path / "one", tmp_path / "two", "--benchmarks", root, "--json")
    done = harness(*score)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(r["tool"], r["score"]) for r in rows[:2]] == [("one", 20), ("two", -150)]
    spec.write_text(spec.read_text() + "; touched\n")
    done = harness(*score)
    assert (done.returncode, "another version of the instance" in done.stderr) == (2, True)


def test_stored_check_is_made_again_with_other_versions(root, make_tool, tmp_path, monkeypatch):
    good = witness_1([0.75], [0.0])
    run(root, make_tool(answers(good, good)), tmp_path / "run")
    judged = []

    def count(entry, record, witness):
        judged.append(entry.id)
        return original(entry, record, witness)

    from harness import checks

    original = checks.check_entry
    monkeypatch.setattr(checks, "check_entry", count)
    score = ("score", tmp_path / "run", "--json")
    harness(*score, "--benchmarks", root)
    assert judged == []
    monkeypatch.setattr(checks, "versions", lambda: {"onnxruntime": "0"})
    harness(*score, "--benchmarks", root)
    assert judged == ["a.k1", "b.k1"]
    for network in (tmp_path / "onnx").iterdir():
        network.unlink()  # not at hand: what is stored is believed
    (root / "unrolled" / "instances.csv").write_text("")
    done = harness(*score, "--benchmarks", root)
    assert (done.returncode, judged) == (0, ["a.k1", "b.k1"])


def test_query_without_a_network_is_one_line(root, tmp_path):
    loose = tmp_path / "loose.vnnlib"
    loose.write_text(query_1(1, 1, *BOX))
    with pytest.raises(BadInput, match="a VNN-LIB file does not name its network"):
        select(root, [], [str(loose)])
    (tmp_path / "w").write_bytes(witness_1([0.75]))
    done = harness("replay", loose, tmp_path / "w", "--benchmarks", root)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    network = tmp_path / "onnx" / "plain.onnx"
    done = harness("replay", loose, tmp_path / "w", "--onnx", network)
    assert done.returncode == 0
    assert done.stdout.startswith("correct: the outputs meet the condition by 0.25\n")


def test_instance_to_replay_by_its_id(root, tmp_path):
    (tmp_path / "w").write_bytes(witness_1([0.75]))
    done = harness("replay", "b.k1", tmp_path / "w", "--benchmarks", root)
    assert (done.returncode, done.stdout.split(":")[0]) == (0, "correct")
    done = harness("replay", "c.k1", tmp_path / "w", "--benchmarks", root)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_query_that_cannot_be_judged_costs_nothing(root, make_tool, tmp_path):
    spec = tmp_path / "vnnlib" / "unrolled" / "1.0" / "a.k1.vnnlib"
    spec.write_text(query_2(1, 1, *BOX).replace("float32", "int8"))
    good = witness_1([0.75], [0.0])
    rows = run(root, make_tool(answers(good, good)), tmp_path / "run")
    assert rows["a.k1"]["witness_check"]["outcome"] == "unsupported"
    done = harness("score", tmp_path / "run", "--benchmarks", root, "--json")
    row = json.loads(done.stdout.splitlines()[0])
    assert (row["score"], row["sat"], row["unknown"], row["incorrect"]) == (10, 1, 1, 0)


def test_results_stay_valid_when_the_files_are_packed_or_unpacked(root, make_tool, tmp_path):
    good = witness_1([0.75], [0.0])
    run(root, make_tool(answers(good, good)), tmp_path / "run")
    archive = tmp_path / "s.tar.gz"
    who = ("--author", "A", "--contact", "a@b.org", "--tool-version", "1")
    where = ("--benchmarks", root)
    assert harness("submit", tmp_path / "run", "-o", archive, *who, *where).returncode == 0
    for path in [*(tmp_path / "onnx").iterdir(), *(tmp_path / "vnnlib").glob("*/*/*")]:
        content = path.read_bytes()
        path.unlink()
        if path.suffix == ".gz":
            path.with_suffix("").write_bytes(gzip.decompress(content))
        else:
            path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(content))
    done = harness("verify-submission", archive, *where)
    assert done.stdout.splitlines()[-1] == "valid: 2 results, 2 witnesses replayed"
    done = harness("score", tmp_path / "run", "--recheck", "--json", *where)
    assert json.loads(done.stdout.splitlines()[0])["score"] == 20
