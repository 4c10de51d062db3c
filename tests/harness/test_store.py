"""What a run folder keeps: any content, against kills, a full disk, readers and other writers."""

import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

import pytest
from harness_helpers import wait_until
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.records import Limits, Record, RunInfo, ToolInfo, Verdict, WitnessCheck, WitnessOutcome
from harness.store import RunFolder
from racecar.errors import BadInput

HASH = "0" * 64


def record(instance, category="quick", result="unsat", **changes):
    fields = {
        "instance": instance,
        "category": category,
        "onnx": "../onnx/a.onnx",
        "spec": f"{category}/json/{instance}.json",
        "onnx_sha256": HASH,
        "spec_sha256": HASH,
        "tool": "fake",
        "tool_version": None,
        "command": ["bash", "run_instance.sh"],
        "started_at": "2026-01-01T00:00:00.000+00:00",
        "prepare_time": 0.0,
        "run_time": 0.5,
        "cpu_time": 0.4,
        "max_memory_mib": 3.5,
        "result": result,
        "verdict": Verdict(result),
        "limits": Limits(
            wall_s=1, wall_end_s=1.1, wall_kill_s=1.3, prepare_wall_s=600, kept_by="subreaper"
        ),
        "log": f"{instance}.log",
    }
    return Record(**{**fields, **changes})


def check_of(instance, outcome=WitnessOutcome.CORRECT):
    return WitnessCheck(
        instance=instance,
        outcome=outcome,
        message="m",
        witness_sha256=HASH,
        spec_sha256=HASH,
        onnx_sha256=HASH,
        checked_with={"numpy": "2"},
    )


INFO = RunInfo(
    tool=ToolInfo(name="fake", version=None, folder="/f", scripts_sha256=HASH),
    benchmarks=None,
    timeout_s=None,
    created_at="2026-01-01T00:00:00+00:00",
    harness_version="0",
    machine={"cores": 2},
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run"


@pytest.fixture
def folder(path):
    """A new run, locked, to which results can be added."""
    with RunFolder.create(path) as made:
        lock = made.lock()
        yield made
        os.close(lock)


def test_a_new_run_is_empty(folder):
    assert not folder.has_begun()
    assert not folder.is_installed()
    assert folder.records() == []
    assert folder.instances() == set()
    assert not folder.has("a")
    assert folder.check("a") is None


contents = st.binary(max_size=5000) | st.integers(0, 300_000).map(lambda n: b"\0x" * n)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,9}", fullmatch=True),
                       st.tuples(st.sampled_from("ab"), contents, st.none() | contents,
                                 st.booleans()), max_size=4))  # fmt: skip
def test_what_is_added_is_read_again_by_anyone(tmp_path, results):
    path = tmp_path / "run"
    shutil.rmtree(path, ignore_errors=True)
    stored = {}
    with RunFolder.create(path) as folder:
        lock = folder.lock()
        folder.write_info(INFO)
        for name, (category, log, witness, checked) in results.items():
            check = check_of(name) if checked else None
            stored[name] = folder.add(record(name, category), log=log, witness=witness, check=check)
        os.close(lock)
    with RunFolder.open(path) as reader:
        assert reader.info() == INFO
        assert reader.instances() == set(results)
        order = sorted(stored.values(), key=lambda r: (r.category, r.instance))
        assert reader.records() == order
        for name, (_, log, witness, checked) in results.items():
            found = reader.record(name)
            assert found == stored[name]
            assert reader.has(name)
            assert reader.log(found) == log
            assert reader.witness(found) == (witness or b"")
            assert (found.witness is None) == (witness is None)
            assert reader.check(name) == (check_of(name) if checked else None)


def test_an_instance_has_one_record(folder):
    folder.add(record("a"), log=b"first", witness=None, check=None)
    with pytest.raises(BadInput, match="has a record already"):
        folder.add(record("a", result="unknown"), log=b"second", witness=b"w", check=check_of("a"))
    assert folder.record("a").result == "unsat"
    assert folder.log(folder.record("a")) == b"first"
    assert folder.check("a") is None


def test_a_check_can_be_replaced(folder):
    folder.add(record("a", result="sat"), log=b"", witness=b"w", check=check_of("a"))
    folder.write_check(check_of("a", WitnessOutcome.WRONG))
    assert folder.check("a").outcome is WitnessOutcome.WRONG


def test_installs_are_kept(folder):
    folder.add_install("it failed", b"no compiler")
    assert not folder.is_installed()
    assert folder.install_log() == b"no compiler"
    folder.add_install(None, b"fine")
    assert folder.is_installed()
    assert folder.install_log() == b"fine"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (shutil.rmtree, "not a run folder"),
        (lambda path: (path / "run.sqlite").unlink(), "has no run.sqlite"),
        (lambda path: (path / "run.sqlite").write_bytes(b"garbage" * 500), "is not a database"),
        (lambda path: run_sql(path, "PRAGMA user_version = 7"), "version 7"),
        (lambda path: run_sql(path, "PRAGMA application_id = 7"), "not the database of a run"),
        (lambda path: run_sql(path, "DROP TABLE records"), "no such table: records"),
        (lambda path: run_sql(path, "UPDATE records SET json = '{}'"), "record of a: instance:"),
        (lambda path: run_sql(path, "UPDATE logs SET content = x'00'"), "is damaged"),
        (lambda path: run_sql(path, "DELETE FROM logs"), "log a.log is not there"),
        (lambda path: run_sql(path, "DELETE FROM records"), "no record of an instance a"),
    ],
)
def test_what_is_not_a_run_is_refused_in_one_line(folder, path, spoil, message):
    folder.add(record("a"), log=b"", witness=None, check=None)
    folder.finish()
    (path / "results.csv").touch()
    spoil(path)

    def read():
        with RunFolder.open(path) as reader:
            reader.records()
            reader.log(reader.record("a"))

    with pytest.raises(BadInput, match=message) as caught:
        read()
    assert "\n" not in str(caught.value)


def run_sql(path, command):
    database = sqlite3.connect(path / "run.sqlite")
    with database:
        database.execute(command)
    database.close()


def test_who_may_not_write_can_read():
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run"
        with RunFolder.create(path) as folder, os.fdopen(folder.lock()):
            folder.add(record("a"), log=b"x", witness=None, check=None)
            folder.finish()
        (path / "run.sqlite").chmod(0o444)
        path.chmod(0o555)
        path.parent.chmod(0o755)
        script = f"""
            import os, pathlib
            from harness.store import RunFolder
            if os.getuid() == 0:
                os.setuid(65534)
            path = pathlib.Path({str(path)!r})
            assert not os.access(path / "run.sqlite", os.W_OK)
            print([r.instance for r in RunFolder.open(path).records()])
        """
        done = in_python(script)
        assert (done.stdout, done.stderr) == ("['a']\n", "")
        path.chmod(0o755)


def in_python(script, **options):
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True, text=True, check=False, timeout=60, **options,
    )  # fmt: skip


def test_two_writers_exclude_each_other(folder, path):
    script = f"""
        import pathlib
        from harness.store import RunFolder
        RunFolder.open(pathlib.Path({str(path)!r})).lock()
    """
    done = in_python(script)
    assert "another harness is working on it" in done.stderr


def add_for_ever(path):
    """Add result after result; the log is long, so that a transaction has many pages."""
    with RunFolder.open(path) as folder, os.fdopen(folder.lock()):
        if not folder.has_begun():
            folder.write_info(INFO)
        number = len(folder.instances())
        while True:
            name = f"i{number:05d}"
            log, witness = os.urandom(100_000), name.encode() * 3000
            folder.add(record(name), log=log, witness=witness, check=check_of(name))
            number += 1


def assert_whole(path):
    """Every record has all that belongs to it, and nothing else is there."""
    with RunFolder.open(path) as folder:
        records = folder.records()
        assert [r.instance for r in records] == [f"i{i:05d}" for i in range(len(records))]
        for stored in records:
            assert len(folder.log(stored)) == 100_000
            assert folder.witness(stored) == stored.instance.encode() * 3000
            assert folder.check(stored.instance) == check_of(stored.instance)
    return len(records)


def assert_nothing_else(path):
    """No row is there but what records have; nobody writes just now."""
    records = assert_whole(path)
    if not records:
        return 0
    with sqlite3.connect(path / "run.sqlite") as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        for table in ("logs", "witnesses", "checks"):
            (rows,) = database.execute(f"SELECT count(*) FROM {table}").fetchone()
            assert rows == records
    database.close()
    return records


def test_a_writer_may_be_killed_at_any_instant(path):
    RunFolder.create(path)
    before = -1
    for i in range(12):
        process = multiprocessing.get_context("fork").Process(target=add_for_ever, args=(path,))
        process.start()
        # The first ones die while they make the tables.
        time.sleep(0.003 * i if i < 4 else 0.02 * i)
        process.kill()
        process.join()
        now = assert_nothing_else(path) if (path / "run.sqlite").exists() else 0
        assert now >= before
        before = now
    assert before > 12


def test_a_run_can_be_read_while_it_is_written(path):
    RunFolder.create(path)
    process = multiprocessing.get_context("fork").Process(target=add_for_ever, args=(path,))
    process.start()
    try:
        counts = []
        wait_until(lambda: (path / "run.sqlite").exists() and RunFolder.open(path).instances())
        for _ in range(5):
            counts.append(assert_whole(path))
            time.sleep(0.05)
        assert counts[-1] > counts[0]  # the writer was not stopped by its readers
        assert process.is_alive()
    finally:
        process.kill()
        process.join()


def test_a_reader_that_is_stopped_does_not_keep_the_writer_waiting(folder, path):
    folder.add(record("a"), log=b"", witness=None, check=None)
    with RunFolder.open(path) as reader:
        assert len(reader.records()) == 1
        folder.add(record("b"), log=b"", witness=None, check=None)
        assert len(reader.records()) == 2


def test_the_disk_may_be_full(path):
    """A limit on the size of files stands for the end of the disk: write(2) fails."""
    RunFolder.create(path)
    script = f"""
        import pathlib, resource, signal, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_store import add_for_ever
        from racecar.errors import BadInput
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
        try:
            add_for_ever(pathlib.Path({str(path)!r}))
        except BadInput as error:
            print(error)
    """
    done = in_python(script)
    assert done.stderr == ""
    assert done.stdout.startswith(f"{path}: ")
    assert done.stdout.count("\n") == 1
    stored = assert_nothing_else(path)
    assert stored > 2
    assert in_python(script).stdout == done.stdout
    assert assert_nothing_else(path) == stored


def test_a_full_database_is_named(folder, path):
    folder.add(record("a"), log=b"", witness=None, check=None)
    folder._open().execute("PRAGMA max_page_count = 20")
    with pytest.raises(BadInput, match="the disk is full; make room, then go on with --resume"):
        folder.add(record("b"), log=os.urandom(200_000), witness=None, check=None)
    assert folder.instances() == {"a"}
    folder._open().execute("PRAGMA max_page_count = 100000")
    folder.add(record("b"), log=os.urandom(200_000), witness=None, check=None)


def test_a_real_full_disk(tmp_path):
    mount = tmp_path / "disk"
    mount.mkdir()
    inside = f"""
        import pathlib, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_store import RunFolder, add_for_ever, assert_nothing_else
        from racecar.errors import BadInput
        path = pathlib.Path({str(mount)!r}) / "run"
        RunFolder.create(path)
        filler = path.parent / "filler"
        filler.write_bytes(bytes(1_000_000))
        for _ in range(2):
            try:
                add_for_ever(path)
            except BadInput as error:
                print(str(error).replace(str(path), "RUN"), assert_nothing_else(path))
            filler.unlink(missing_ok=True)
    """
    command = f'mount -t tmpfs -o size=3m none {mount} && exec "$0" -c "$1"'
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", command,
         sys.executable, textwrap.dedent(inside)],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    if "unshare" in done.stderr or "mount" in done.stderr:
        pytest.skip("a file system of its own cannot be made here")
    assert done.stderr == ""
    first, second = done.stdout.splitlines()
    line = "RUN: the disk is full; make room, then go on with --resume "
    assert first.startswith(line)
    assert second.startswith(line)
    assert int(second.split()[-1]) > int(first.split()[-1]) > 2
