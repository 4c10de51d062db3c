"""What a tool cannot spoil: its surroundings, its folders for the next, the harness."""

import os
import threading
import time

import psutil
import pytest
from harness_helpers import BOTH, TIMEOUT, wait_until

from harness import landlock
from harness.bounds import NOTHING
from harness.limits import Allowance
from harness.scratch import disk_usage, remove

needs_landlock = pytest.mark.skipif(
    not landlock.can_forbid_writes(), reason="Landlock 3 (Linux 6.2) is needed"
)


@needs_landlock
def test_contained_tool_writes_nowhere_else(make_runner, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "old").write_text("old")
    run = (
        f"cd {outside}\n"
        "echo x > new; mkdir folder; ln -s old link; echo x >> old; rm old; mv old older\n"
        "setsid -w bash -c 'echo x > other; truncate -s 0 old'\n"
        'echo x > /dev/null && echo x > "$TMPDIR/x" && echo x > "$HOME/x" && cat old\n'
        'echo unsat > "$RESULTS"'
    )
    runner, entry = make_runner(run, limits=Allowance(contain=True, fresh_home=True))
    finished = runner.run(entry)
    assert finished.record.result == "unsat"
    assert {path.name: path.read_text() for path in outside.iterdir()} == {"old": "old"}
    assert finished.log.endswith(b"\nold")
    assert finished.record.limits.writes_by == "landlock"


def test_uncontained_tool_is_said_to_be_so(make_runner, tmp_path):
    runner, entry = make_runner(f"echo x > {tmp_path}/outside")
    record = runner.run(entry).record
    assert record.limits.writes_by == NOTHING
    assert (tmp_path / "outside").read_text() == "x\n"


def test_killing_its_supervisor(make_runner, tmp_path, monkeypatch):
    # Once only; the next instance is run by a new one.
    run = (
        '[ -e "$ONCE" ] || { touch "$ONCE"; kill -KILL $PPID; sleep 1000; }\n'
        'echo unsat > "$RESULTS"'
    )
    monkeypatch.setenv("ONCE", str(tmp_path / "once"))
    runner, entry = make_runner(run)
    record = runner.run(entry).record
    assert record.result == "error"
    assert record.detail == "the process that keeps the limits was killed"
    assert runner.run(entry).record.result == "unsat"


def test_killing_all_programs_called_python(make_runner):
    runner, _ = make_runner("")
    guard = psutil.Process(runner._supervisor._process.pid)
    (keeper,) = guard.children()
    assert {guard.name(), keeper.name()} == {"closedlap-keep"}


def test_killing_the_harness(make_runner):
    if not landlock.can_forbid_signals(no_new_privileges=False):
        pytest.skip("Landlock 6 (Linux 6.12) and root are needed")
    run = f'kill -0 {os.getpid()} || kill -0 {{guard}} || echo unsat > "$RESULTS"'
    runner, entry = make_runner("")
    script = run.format(guard=runner._supervisor._process.pid)
    runner.tool.folder.joinpath("run_instance.sh").write_text(f'RESULTS="$5"; {script}')
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert record.limits.signals_by == "landlock"


@needs_landlock
def test_contained_tool_reaches_no_other_process(make_runner):
    if not landlock.can_forbid_signals(no_new_privileges=True):
        pytest.skip("Landlock 6 (Linux 6.12) is needed")
    run = f'kill -0 {os.getpid()} || echo unsat > "$RESULTS"'
    runner, entry = make_runner(run, limits=Allowance(contain=True))
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert record.limits.signals_by == "landlock"


@pytest.mark.parametrize(
    "thing", ["", "; touch $D", "; ln -s $PRECIOUS $D", "; mkdir $D; touch $D/work $D/tmp"]
)
def test_scratch_that_prepare_instance_spoils(make_runner, tmp_path, monkeypatch, thing):
    (tmp_path / "precious").mkdir()
    monkeypatch.setenv("PRECIOUS", str(tmp_path / "precious"))
    prepare = f"D=$(dirname $PWD); cd /; rm -rf $D{thing}"
    runner, entry = make_runner('touch x "$TMPDIR/x"; echo unsat > "$RESULTS"', prepare=prepare)
    for _ in range(2):
        assert runner.run(entry).record.result == "unsat"
    assert list((tmp_path / "precious").iterdir()) == []


@pytest.mark.parametrize("thing", ["mkdir -p $LOG/a", "mkfifo $LOG", "ln -s $PRECIOUS $LOG", ":"])
def test_log_that_was_tampered_with_is_begun_anew(make_runner, tmp_path, monkeypatch, thing):
    precious = tmp_path / "precious"
    precious.write_text("x")
    monkeypatch.setenv("PRECIOUS", str(precious))
    prepare = f"LOG=$(dirname $PWD).log; rm $LOG; {thing}"
    runner, entry = make_runner('echo printed; echo unsat > "$RESULTS"', prepare=prepare)
    for _ in range(2):
        finished = runner.run(entry)
        assert finished.record.result == "unsat"
        assert finished.log == b"printed\n"
    assert precious.read_text() == "x"


def test_each_instance_begins_in_empty_folders(make_runner):
    # The folder may be that of the instance before: nothing of it may be left, rights included.
    show = 'find "$(dirname "$PWD")" -printf "%P %y %m\n" | sort'
    spoil = 'touch x ../home/.x "$TMPDIR/y"; mkdir ../home/z; chmod 755 .; echo unsat > "$RESULTS"'
    runner, entry = make_runner(f"{show}; {spoil}")
    first = runner.run(entry).log
    assert first.decode().split("\n") == [
        " d 700",
        "home d 700",
        "tmp d 700",
        "work d 700",
        "",
    ]
    assert runner.run(entry).log == first
    runner.tool.folder.joinpath("run_instance.sh").write_text(show)
    assert runner.run(entry).log == first
    assert runner.run(entry).log == first


def test_everything_below_a_folder_is_removed_and_no_link_followed(tmp_path):
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "file").write_text("x")
    top = deep = tmp_path / "top"
    for i in range(130):
        deep = deep / f"{i}"
    deep.mkdir(parents=True)
    (deep / "file").write_bytes(bytes(1_000_000))
    (deep / "link").symlink_to(kept)
    (top / "link").symlink_to(kept)
    (top / "side").mkdir()
    (top / "side" / "file").write_text("x")
    (top / "side").chmod(0)
    (top / "0" / "1").chmod(0)
    assert disk_usage(str(top)) >= 1_000_000
    # A look ends when it is told to, with what it has seen.
    assert disk_usage(str(top), until=time.monotonic()) == 0
    remove(str(top))
    remove(str(tmp_path / "absent"))
    (tmp_path / "link").symlink_to(kept)
    remove(str(tmp_path / "link"))
    assert list(tmp_path.iterdir()) == [kept]
    assert (kept / "file").read_text() == "x"


def sleepers(seconds):
    found = []
    for process in psutil.process_iter(["cmdline", "status"]):
        if process.info["cmdline"] == ["sleep", seconds] and process.info["status"] != "zombie":
            found.append(process.pid)
    return found


@BOTH
@pytest.mark.parametrize("victim", ["keeper", "guard"])
def test_lost_keeper_is_noticed_and_its_tree_ended(make_runner, cgroups, victim):
    # A process that has shed session, parent and environment is still found.
    seconds = f"100{os.getpid()}.{int(cgroups)}{len(victim)}"
    run = f"env -i setsid -f sleep {seconds}; sleep {seconds}"
    runner, entry = make_runner(run, timeout=1.5, limits=Allowance(cgroups=cgroups))
    guard = psutil.Process(runner._supervisor._process.pid)

    def kill():
        wait_until(lambda: len(sleepers(seconds)) == 2)
        (guard.children()[0] if victim == "keeper" else guard).kill()

    thread = threading.Thread(target=kill)
    thread.start()
    record = runner.run(entry).record
    thread.join()
    # Without its guard the keeper goes on as before.
    assert record.result == ("error" if victim == "keeper" else TIMEOUT)
    assert sleepers(seconds) == []
    runner.tool.folder.joinpath("run_instance.sh").write_text('echo unsat > "$5"')
    assert runner.run(entry).record.result == "unsat"
