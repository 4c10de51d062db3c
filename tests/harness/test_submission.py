"""A submission is packed so that it can be judged again; whatever was touched is found."""

import contextlib
import gzip
import hashlib
import io
import json
import tarfile

import jsonschema
import pytest
from harness_helpers import harness
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.submission.archive import Refused, read_archive, write_archive
from harness.submission.model import json_schema, schema_text
from harness.submission.verify import verify_submission

WHO = ("--author", "Ada Author", "--author", "Bo O'Writer", "--contact", "ada@example.org")
SAT = '{"s": 0.28, "f": 9.9, "v": 0, "theta": 0}'
ANSWERS = f"""case $ID in
one) printf 'sat\\n%s\\n' '{SAT}' > "$RESULTS" ;;
two) echo unsat > "$RESULTS" ;;
three) echo sat > "$RESULTS" ;;
*) exit 3 ;;
esac"""


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A submission of four results, and the benchmarks that they are of."""
    from harness_helpers import Benchmarks

    folder = tmp_path_factory.mktemp("submission")
    benchmarks = Benchmarks(folder / "set")
    for name in ("one", "two", "three", "four"):
        benchmarks.add(name, (0.25, 0.5))
    tool = folder / "tool"
    tool.mkdir()
    (tool / "prepare_instance.sh").write_text("")
    head = 'ID=$(basename "$4" .json) RESULTS="$5"\n'
    (tool / "run_instance.sh").write_text(head + ANSWERS)
    (tool / "VERSION").write_text("1.2\n")
    where = ("--benchmarks", benchmarks.root)
    done = harness("run", "--tool", tool, "--out", folder / "run", *where)
    assert done.returncode == 0, done.stderr
    return folder / "run", benchmarks, submit(folder / "run", folder / "a.tar.gz", *where)


def submit(run, output, *options):
    done = harness("submit", run, "-o", output, *WHO, *options)
    assert done.returncode == 0, done.stderr
    return output


def verify(file, benchmarks):
    done = harness("verify-submission", file, "--benchmarks", benchmarks.root, "--json")
    (line,) = done.stdout.splitlines()
    found = json.loads(line)
    assert done.returncode == (0 if found["valid"] else 1)
    return found


def files_of(archive):
    return dict(read_archive(archive))


def rebuilt(files, path, honest=True):
    """Write an archive of changed files; honest: with a list that fits them."""
    files = dict(files)
    if honest:
        data = json.loads(files["submission.json"])
        data["files"] = [
            {"path": name, "size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in sorted(files.items())
            if name != "submission.json"
        ]
        files["submission.json"] = json.dumps(data).encode()
    with path.open("wb") as target:
        write_archive(sorted(files.items()), target)
    return path


def test_round_trip(packed):
    run, benchmarks, archive = packed
    found = verify(archive, benchmarks)
    assert (found["valid"], found["problems"], found["witnesses"]) == (True, [], 2)
    assert found["about"]["authors"] == ["Ada Author", "Bo O'Writer"]
    assert (found["about"]["tool"], found["about"]["version"]) == ("tool", "1.2")
    assert found["rows"][0]["score"] == 10 + 10 - 150
    done = harness("score", run, "--benchmarks", benchmarks.root, "--json")
    assert [json.loads(line) for line in done.stdout.splitlines()] == found["rows"]
    shown = harness("verify-submission", archive, "--benchmarks", benchmarks.root)
    assert "tool 1.2, by Ada Author, Bo O'Writer\n" in shown.stdout
    assert shown.stdout.endswith("valid: 4 results, 2 witnesses replayed\n")


def test_submissions_are_scored_like_runs(packed, tmp_path):
    run, benchmarks, archive = packed
    where = ("--benchmarks", benchmarks.root, "--json")
    assert harness("score", archive, *where) == harness("score", run, *where)
    done = harness("score", archive, run, *where)
    assert (done.returncode, "already has a result for" in done.stderr) == (2, True)
    files = files_of(archive)
    edit(RECORDS, tool="other")(files)
    done = harness("score", rebuilt(files, tmp_path / "x.tar.gz"), *where)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "not a valid submission (one: it is a result of other" in done.stderr


def test_same_run_gives_the_same_bytes(packed, tmp_path):
    run, benchmarks, archive = packed
    again = submit(run, tmp_path / "b.tar.gz", "--benchmarks", benchmarks.root)
    assert again.read_bytes() == archive.read_bytes()
    with tarfile.open(archive) as members:
        assert all((m.mtime, m.uid, m.uname, m.mode) == (0, 0, "", 0o644) for m in members)


def test_files_match_the_published_schema(packed):
    schema, files = json_schema(), files_of(packed[2])
    jsonschema.Draft202012Validator.check_schema(schema)

    def check(name, text):
        part = {**schema["properties"][name], "$defs": schema["$defs"]}
        jsonschema.validate(json.loads(text), part)

    check("submission.json", files["submission.json"])
    check("results.json", files["results.json"])
    check("runs/N/run.json", files["runs/0/run.json"])
    for kind in ("records", "checks"):
        for line in files[f"runs/0/{kind}.jsonl"].splitlines():
            check(f"runs/N/{kind}.jsonl, each line", line)


def test_published_schema_is_current():
    from query_helpers import REPOSITORY

    assert (REPOSITORY / "docs" / "submission.schema.json").read_text() == schema_text()
    assert harness("submit", "--schema").stdout == schema_text()


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_changed_byte_is_found(packed, tmp_path, data):
    _, benchmarks, archive = packed
    files = files_of(archive)
    name = data.draw(st.sampled_from([n for n, content in files.items() if content]))
    content = bytearray(files[name])
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    files[name] = bytes(content)
    found = verify_submission(rebuilt(files, tmp_path / "x.tar.gz", False), benchmarks.root)
    if found.problems:
        return
    # submission.json itself is not listed: who submits may say what they like of themselves.
    assert name == "submission.json"
    assert found.about is not None


def edit(part, **changes):
    """Return a function that changes fields of one JSON line (of instance ``one``) in a file."""

    def apply(files):
        lines = []
        for line in files[part].decode().splitlines():
            data = json.loads(line)
            if data.get("instance") == changes.get("instance", "one"):
                for key, value in changes.items():
                    if key != "instance":
                        data[key] = value
            lines.append(json.dumps(data))
        files[part] = ("\n".join(lines) + "\n").encode()

    return apply


def without(name):
    def apply(files):
        del files[next(n for n in files if n.startswith(name))]

    return apply


def twice(part):
    def apply(files):
        files[part] += files[part].splitlines(keepends=True)[0]

    return apply


def other_witness(files):
    name = next(n for n in files if n.startswith("witnesses/") and files[n])
    files[name] = SAT.replace("0.28", "0.4").encode()


def lying_check(files):
    edit("runs/0/checks.jsonl", instance="three", outcome="correct", message="trust me")(files)
    results = json.loads(files["results.json"])
    for row in results["rows"]:
        row.update(score=30, incorrect=0, bad_witness=0, sat=2)
    files["results.json"] = json.dumps(results).encode()


RECORDS, CHECKS, RUN = "runs/0/records.jsonl", "runs/0/checks.jsonl", "runs/0/run.json"
NOTHING = hashlib.sha256(b"").hexdigest()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_witness, "its sha256 is not its name"),
        (lying_check, "its witness is said to be correct, but is missing (nothing follows sat)"),
        (lying_check, "counted again, the results are others"),
        (edit(RECORDS, result="unsat", verdict="unsat"), "counted again, the results are others"),
        (edit(RECORDS, result="unsat", verdict="unsat"), "a witness check, but no result sat"),
        (edit(RECORDS, result="unsat"), "verdict is sat, but result is unsat"),
        (edit(RECORDS, spec_sha256="0" * 64), "it was run on another one.json (sha256 differs)"),
        (edit(RECORDS, onnx_sha256="0" * 64), "it was run on another straight.onnx"),
        (edit(CHECKS, spec_sha256="0" * 64), "its witness check is of other files than its record"),
        (edit(RECORDS, spec="/etc/passwd"), "its files are not those that the benchmarks name"),
        (edit(RECORDS, onnx="../../../x"), "its files are not those that the benchmarks name"),
        (edit(RECORDS, category="full_range"), "the benchmarks have none such in full_range"),
        (edit(RECORDS, tool="other"), "it is a result of other 1.2, in a run of another tool"),
        (edit(RECORDS, tool_version="2"), "it is a result of tool 2, in a run of another tool"),
        (edit(RECORDS, started_at="yesterday"), "started_at is 'yesterday', not a time"),
        (edit(RECORDS, extra=1), "extra: Extra inputs are not permitted"),
        (edit(RECORDS, run_time=1e9), "result is sat, but run_time is above the limit"),
        (edit(RECORDS, run_time=float("nan")), "run_time"),
        (edit(CHECKS, witness_sha256="1" * 64), "its witness 111111111111... is missing"),
        (edit(CHECKS, witness_sha256="1" * 64), "no result has this witness"),
        (edit(CHECKS, witness_sha256=NOTHING), "said to be correct, but is missing"),
        (twice(RECORDS), "it has two results"),
        (twice(CHECKS), "has two checks"),
        (without("results.json"), "it is missing"),
        (without(RUN), "it is missing"),
        (without(CHECKS), "the result is sat, but there is no witness check"),
        (without("witnesses/"), "is missing"),
        (lambda files: files.update({RECORDS: b""}), "it has no results"),
        (lambda files: files.update({RECORDS: b"\n" * 1_000_000}), "so many lines are wrong"),
        (lambda files: files.update({"runs/7/run.json": b"{}"}), "speaks of 1 runs only"),
        (lambda files: files.update({"witnesses/" + "1" * 64: b"x"}), "sha256 is not its name"),
        (lambda files: files.update({"results.json": b"\x80\x04pickle"}), "Invalid JSON"),
    ],
)
def test_what_was_made_up_is_found(packed, tmp_path, change, message):
    _, benchmarks, archive = packed
    files = files_of(archive)
    change(files)
    found = verify(rebuilt(files, tmp_path / "x.tar.gz"), benchmarks)
    assert not found["valid"]
    whats = [problem["what"] for problem in found["problems"]]
    assert any(message in what for what in whats), whats


def test_longer_limit_than_allowed_is_found(packed, tmp_path):
    _, benchmarks, archive = packed
    files = files_of(archive)
    line = json.loads(files[RECORDS].splitlines()[0])
    edit(RECORDS, instance="four", limits={**line["limits"], "wall_s": 60.0})(files)
    found = verify(rebuilt(files, tmp_path / "x.tar.gz"), benchmarks)
    assert found["problems"][0] == {
        "where": "four",
        "what": "the tool had 60 s; the instance allows 10 s",
    }


def test_changed_benchmarks_are_found(packed, tmp_path):
    _, benchmarks, archive = packed
    spec = benchmarks.root / "quick" / "json" / "two.json"
    before = spec.read_bytes()
    try:
        spec.write_bytes(before + b"\n")
        found = verify(archive, benchmarks)
    finally:
        spec.write_bytes(before)
    assert [p["where"] for p in found["problems"]] == ["two"]


def test_text_is_plain(packed, tmp_path):
    run, benchmarks, archive = packed
    for who in (
        ("--author", "<b>Ada</b>", "--contact", "a@example.org"),
        ("--author", "Ada\x1b[31m", "--contact", "a@example.org"),
        ("--author", "Ada\u202e", "--contact", "a@example.org"),
        ("--author", "Ada", "--contact", "nowhere"),
        ("--author", "Ada", "--contact", "a@example.org", "--url", "javascript:alert(1)"),
        ("--author", "A" * 500, "--contact", "a@example.org"),
    ):
        done = harness("submit", run, "-o", tmp_path / "x.tar.gz", *who)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert not (tmp_path / "x.tar.gz").exists()
    files = files_of(archive)
    data = json.loads(files["submission.json"])
    data["about"]["authors"] = ["<script>"]
    files["submission.json"] = json.dumps(data).encode()
    found = verify(rebuilt(files, tmp_path / "y.tar.gz"), benchmarks)
    assert "'<' may not stand in it" in found["problems"][0]["what"]
    data["about"] = {"\x1b[31mevil\n": 1}
    files["submission.json"] = json.dumps(data).encode()
    shown = harness(
        "verify-submission",
        rebuilt(files, tmp_path / "z.tar.gz"),
        "--benchmarks",
        benchmarks.root,
    )
    assert shown.returncode == 1
    assert "\x1b" not in shown.stdout


def test_runs_of_different_tools_are_not_one_submission(packed, tmp_path):
    run, benchmarks, _ = packed
    where = ("--benchmarks", benchmarks.root)
    tool = run.parent / "tool"
    done = harness("run", "--tool", tool, "--name", "b", "--out", tmp_path / "b", *where)
    assert done.returncode == 0
    for other, message in ((tmp_path / "b", "it is a run of tool b, not tool"),):
        done = harness("submit", run, other, "-o", tmp_path / "x.tar.gz", *WHO, *where)
        assert (done.returncode, message in done.stderr) == (2, True)
    done = harness("submit", run, "-o", tmp_path / "x.zip", *WHO, *where)
    assert "give a file that ends in .tar.gz" in done.stderr


# --- hostile archives -------------------------------------------------------------------------


def hostile(path, *members, tail=b"", format=tarfile.USTAR_FORMAT):
    """Write an archive with tarfile: members are TarInfo or (TarInfo, content)."""
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w", format=format) as archive:
        for member in members:
            info, content = member if isinstance(member, tuple) else (member, b"")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    path.write_bytes(gzip.compress(raw.getvalue() + tail))
    return path


def member(name, type=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = type, link
    return info


def bomb(size):
    """A header that promises zeros, and compressed zeros."""
    info = member("witnesses/" + "0" * 64)
    info.size = size
    return gzip.compress(info.tobuf(tarfile.GNU_FORMAT) + bytes(1 << 20))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: hostile(p, member("../evil")), "'../evil' is not a file of a submission"),
        (lambda p: hostile(p, member("/etc/passwd")), "is not a file of a submission"),
        (lambda p: hostile(p, member("runs/0/../../x")), "is not a file of a submission"),
        (lambda p: hostile(p, member("submission.json", tarfile.SYMTYPE, "/etc/passwd")), "plain"),
        (lambda p: hostile(p, member("submission.json", tarfile.LNKTYPE, "x")), "not a plain file"),
        (lambda p: hostile(p, member("submission.json", tarfile.FIFOTYPE)), "not a plain file"),
        (lambda p: hostile(p, member("submission.json", tarfile.CHRTYPE)), "not a plain file"),
        (lambda p: hostile(p, member("submission.json", tarfile.GNUTYPE_SPARSE)), "plain file"),
        (lambda p: hostile(p, member("runs/0", tarfile.DIRTYPE)), "is not a plain file"),
        (
            lambda p: hostile(p, member("x" * 10_000_000), format=tarfile.GNU_FORMAT),
            "is not a plain file (type b'L')",
        ),
        (
            lambda p: hostile(p, member("x" * 10_000_000), format=tarfile.PAX_FORMAT),
            "is not a plain file (type b'x')",
        ),
        (
            lambda p: hostile(p, (member("results.json"), b"1"), (member("results.json"), b"2")),
            "'results.json' stands twice",
        ),
        (
            lambda p: hostile(p, (member("submission.json"), b""), (member("results.json"), b"")),
            "'results.json' is out of order",
        ),
        (lambda p: hostile(p, member("results.json"), tail=b"more"), "something follows the end"),
        (lambda p: p.write_bytes(bomb(1 << 33)), "bytes; 16777217 are allowed"),
        (lambda p: p.write_bytes(bomb(-1)), "has -1 bytes; 16777217 are allowed"),
        (lambda p: p.write_bytes(bomb(1 << 24)), "it ends in the middle of a file"),
        (lambda p: p.write_bytes(b"PK\x03\x04 a zip file"), "not a complete gzip file"),
        (lambda p: p.write_bytes(gzip.compress(b"x" * 600)), "it is not a tar archive"),
        (lambda p: p.write_bytes(gzip.compress(bytes(5 << 20))), "follows the end"),
        (lambda p: p.write_bytes(b""), "it ends in the middle of a file"),
        (lambda p: hostile(p, member("<b>.json")), "is not a file of a submission"),
        (lambda p: hostile(p, member("results.json")), "it holds no submission.json"),
        (
            lambda p: hostile(p, (member("submission.json"), b"\x80\x04\x95pickle")),
            "submission.json: Invalid JSON",
        ),
        (
            lambda p: hostile(p, (member("submission.json"), b"[" * 100_000)),
            "submission.json: Invalid JSON",
        ),
    ],
)
def test_hostile_archives_are_refused(benchmarks, tmp_path, make, message):
    benchmarks.add("one")
    path = tmp_path / "hostile.tar.gz"
    make(path)
    before = set(tmp_path.rglob("*"))
    found = verify(path, benchmarks)
    (problem,) = found["problems"]
    assert problem["what"].startswith("refused: ")
    assert message in problem["what"]
    assert len(problem["what"]) < 500
    assert set(tmp_path.rglob("*")) == before


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_archives_are_refused_or_read(packed, tmp_path, data):
    content = bytearray(gzip.decompress(packed[2].read_bytes()))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.sampled_from([len(content), data.draw(st.integers(0, len(content)))]))
    path = tmp_path / "x.tar.gz"
    path.write_bytes(gzip.compress(bytes(content[:cut])))
    names = []
    with contextlib.suppress(Refused):  # and nothing else
        names += [name for name, _ in read_archive(path)]
    assert names == sorted(set(names))


def test_missing_file_is_bad_input(benchmarks, tmp_path):
    benchmarks.add("one")
    done = harness("verify-submission", tmp_path / "none", "--benchmarks", benchmarks.root)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
