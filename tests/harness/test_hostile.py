"""Hostile tools: each gets its code, leaves nothing behind and spoils no other result."""

import csv
import json
import os
import threading
import time
from pathlib import Path

import psutil
import pytest
from harness_helpers import carriers, harness, harness_process, wait_until

from harness import landlock
from harness.bounds import NOTHING
from harness.catalogue import select
from harness.limits import Allowance
from harness.records import Record
from harness.runner import Runner
from harness.scratch import disk_usage, remove
from harness.store import RunFolder
from harness.supervisor import Supervisor
from harness.tool import find_tool
from racecar.errors import BadInput

#: Limits of the whole run (MiB), and time (s) for those that are to run into it.
MEMORY, OUTPUT, SCRATCH, WALL = 400, 16, 24, 0.5

TIMEOUT, KILLED, NONE = "run_instance_timeout", "error_exit_code_137", "no_result_in_file"
TOO_MUCH = {
    "memory": "it used more than the limit of 400 MiB of memory",
    "output": "it used more than the limit of 16 MiB of printed output, or of the result file",
    "scratch": "it used more than the limit of 24 MiB in its scratch folder",
}

#: Name: (what the tool does, its code, words of the record's detail).
DEEDS = {
    "honest": ('echo unsat > "$RESULTS"', "unsat", None),
    # It never ends.
    "hangs": ("sleep 1000", TIMEOUT, None),
    "spins": ("while :; do :; done", TIMEOUT, None),
    "ignores_signals": ("trap '' TERM INT HUP XCPU; while :; do sleep 0.05; done", TIMEOUT, None),
    "stops_itself": ("kill -STOP $$", TIMEOUT, None),
    "answers_and_hangs": ('echo unsat > "$RESULTS"; sleep 1000', TIMEOUT, None),
    # It multiplies, and hides.
    "setsid_children": (
        "for i in {1..20}; do setsid -f sleep 1000; done; sleep 1000",
        TIMEOUT,
        None,
    ),
    "fork_bomb": (
        """exec "$PYTHON" -c '
import os, signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
for i in range(7):
    if os.fork() == 0:
        os.setsid()
time.sleep(1000)'""",
        TIMEOUT,
        None,
    ),
    "forks_in_a_loop": (
        'bomb() { (sleep 0.01; exec setsid -f bash -c "$CODE") & }\n'
        "export CODE='trap \"\" TERM; while :; do setsid -f sleep 5; sleep 0.02; done'\n"
        "bomb; bomb; sleep 1000",
        TIMEOUT,
        None,
    ),
    "hands_itself_on": (
        """exec "$PYTHON" -c '
import os
open(os.environ["RESULTS"], "w").write("unsat")
if os.fork(): os._exit(0)
while True:
    os.setsid()
    if os.fork(): os._exit(0)'""",
        "unsat",
        None,
    ),
    "leaves_children": (
        "setsid -f bash -c 'trap \"\" TERM; sleep 1000; sleep 1000'; sleep 1000 &\n"
        'echo unsat > "$RESULTS"',
        "unsat",
        None,
    ),
    "answers_later": ('setsid -f bash -c "sleep 0.3; echo sat > $RESULTS"', NONE, None),
    "without_a_trace": (
        'env -i setsid -f sleep 1000; echo unsat > "$RESULTS"',
        "unsat",
        None,
    ),
    # It takes too much.
    "eats_memory": (
        '"$PYTHON" -c "x = bytearray(900 << 20); input()"; echo unsat > "$RESULTS"',
        KILLED,
        "memory",
    ),
    "eats_memory_in_children": (
        'for i in 1 2 3 4 5; do "$PYTHON" -c "import time\n'
        'x = bytearray(120 << 20); time.sleep(1000)" & done; wait',
        KILLED,
        "memory",
    ),
    "floods_stdout": ("yes", KILLED, "output"),
    "floods_stderr_in_child": ("setsid -f yes >&2; sleep 1000", KILLED, "output"),
    "prints_much": ('head -c 5000000 /dev/zero; echo unsat > "$RESULTS"', "unsat", None),
    "huge_result": (
        '(echo unsat; head -c 1000000000 /dev/zero) > "$RESULTS"',
        KILLED,
        "output",
    ),
    "sparse_result": ('echo unsat > "$RESULTS"; truncate -s 1G "$RESULTS"', KILLED, "output"),
    "fills_scratch": (
        'for i in {1..100}; do head -c 1000000 /dev/zero > $i; done; echo unsat > "$RESULTS"',
        KILLED,
        "scratch",
    ),
    "fills_tmp_and_work": (
        'for d in . "$TMPDIR"; do head -c 16000000 /dev/zero > "$d/a"; done; sleep 1000',
        KILLED,
        "scratch",
    ),
    "fills_files_without_names": (
        "exec 7> file; rm file; head -c 32000000 /dev/zero >&7; sleep 1000",
        KILLED,
        "scratch",
    ),
    # It answers badly.
    "garbage": ("printf '\\xff\\xfe\\0\\1unsat\\n' > \"$RESULTS\"", "error", None),
    "one_long_line": ('head -c 2000000 /dev/zero | tr "\\0" u > "$RESULTS"', "error", None),
    "result_is_a_folder": ('mkdir "$RESULTS"', NONE, None),
    "result_is_a_pipe": ('mkfifo "$RESULTS"', NONE, None),
    "result_is_a_device": ('ln -s /dev/zero "$RESULTS"', NONE, None),
    "result_is_a_link": ('echo unsat > ../mine; ln -s ../mine "$RESULTS"', NONE, None),
    "sat_wrong": (
        """printf 'sat\\n{"s":0.4,"f":9.9,"v":0,"theta":0}' > "$RESULTS" """,
        "sat",
        None,
    ),
    "sat_outside": (
        """printf 'sat\\n{"s":9,"f":9.9,"v":0,"theta":0}' > "$RESULTS" """,
        "sat",
        None,
    ),
    "sat_nan": ("""printf 'sat\\n{"s":NaN,"f":9.9,"v":0,"theta":0}' > "$RESULTS" """, "sat", None),
    "sat_missing": ('echo sat > "$RESULTS"', "sat", None),
    # It ends badly.
    "exit_139": ('echo unsat > "$RESULTS"; exit 139', "error_exit_code_139", None),
    "segfault": ('echo unsat > "$RESULTS"; kill -SEGV $$', "error_exit_code_139", None),
    "kills_its_group": ('echo unsat > "$RESULTS"; kill -KILL 0', KILLED, None),
    # It spoils its surroundings.
    "deletes_scratch": (
        'cd /; rm -rf "$(dirname "$RESULTS")"; echo unsat > "$RESULTS"; true',
        NONE,
        None,
    ),
    "deletes_all_scratch": ('cd /; rm -rf "$(dirname "$RESULTS")/.."; true', NONE, None),
    "link_for_scratch": (
        'cd /; D=$(dirname "$RESULTS"); rm -rf "$D"; ln -s "$PRECIOUS" "$D"',
        NONE,
        None,
    ),
    # What may not be read cannot be measured: root reads all.
    "takes_rights_away": (
        'mkdir -p a/b; chmod 0 a/b a .; echo unsat > "$RESULTS"',
        *(("unsat", None) if os.geteuid() == 0 else (KILLED, "scratch")),
    ),
    "deep_folders": (
        """"$PYTHON" -c '
import os
for i in range(40):
    os.mkdir("d" * 200); os.chdir("d" * 200)
open("file", "w")' && exit 7""",
        "error_exit_code_137",
        "scratch",
    ),
    "folder_for_log": ("rm -f ../../*.log; mkdir -p ../../{a..c}.log; echo x", NONE, None),
    "strange_names": (
        """touch -- '-rf' $'new\\nline' $'\\xff' '*'; echo unsat > "$RESULTS" """,
        "unsat",
        None,
    ),
}
CHECKS = {
    "sat_wrong": "wrong",
    "sat_outside": "out_of_box",
    "sat_nan": "malformed",
    "sat_missing": "missing",
}


def script(deeds):
    cases = "\n".join(f"{name})\n{deed[0]}\n;;" for name, deed in deeds.items())
    return f"export RESULTS\ncase $ID in\n{cases}\nesac"


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder in which scratch folders are made; in the end it must be empty."""
    folder = tmp_path / "t"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("option", [(), ("--no-cgroups",)], ids=["cgroups", "fallback"])
def test_every_deed_has_its_code(
    benchmarks, make_tool, marker, temporary, tmp_path, monkeypatch, option
):
    for name, (_, code, _) in DEEDS.items():
        # Those that answer, or take too much, get enough time for a busy machine.
        benchmarks.add(name, (0.25, 0.5), timeout=WALL if code == TIMEOUT else 30)
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("x")
    monkeypatch.setenv("PRECIOUS", str(precious))
    limits = ("--memory-limit", MEMORY, "--output-limit", OUTPUT, "--scratch-limit", SCRATCH)
    out = tmp_path / "run"
    arguments = ("--tool", make_tool(script(DEEDS)), "--benchmarks", benchmarks.root, "--out", out)
    jobs = ("--jobs", min(2, len(os.sched_getaffinity(0))))
    done = harness_process("run", *arguments, *limits, *jobs, *option, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    results = {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}
    assert {name: r["result"] for name, r in results.items()} == {
        name: code for name, (_, code, _) in DEEDS.items()
    }
    assert carriers(marker) == []
    assert (precious / "file").read_text() == "x"
    for name, result in results.items():
        assert result["detail"] == TOO_MUCH.get(DEEDS[name][2], result["detail"]), name
        assert (result["witness_check"] or {}).get("outcome") == CHECKS.get(name), name
        record = Record(**{k: v for k, v in result.items() if k != "witness_check"})
        if record.result == TIMEOUT:
            assert WALL < record.run_time < WALL + 0.5, name
        limit = record.limits
        assert (limit.memory_mib.kept, limit.output_mib.kept, limit.scratch_mib.kept) == (
            MEMORY,
            OUTPUT,
            SCRATCH,
        )
        assert limit.cpu_s.kept is None
        if option:
            assert limit.memory_mib.by == "samples"
            assert limit.kept_by == "subreaper"
    # The other results of the same run stand.
    with RunFolder.open(out) as run:
        assert run.record("honest").verdict == "unsat"
    with (out / "results.csv").open() as file:
        assert len(list(csv.reader(file))) == len(DEEDS)


@pytest.fixture
def make_runner(benchmarks, make_tool, temporary, marker):
    """Return a function that makes a Runner and an entry for one script."""
    runners = []

    def make(run, timeout=30.0, prepare="", **options):
        benchmarks.add("one", (0.25, 0.5), timeout=timeout)
        tool = find_tool(str(make_tool(run, prepare)))
        runners.append(Runner(tool, benchmarks.root, **options))
        return runners[-1], select(benchmarks.root, (), ("one",))[0]

    yield make
    for runner in runners:
        runner.close()


BOTH = pytest.mark.parametrize("cgroups", [True, False], ids=["cgroups", "fallback"])


SPIN = {
    "sessions": "for i in 1 2; do setsid -f bash -c 'while :; do :; done'; done; sleep 1000",
    # The time of children that nobody waits for is added to nobody's.
    "one after another": """exec "$PYTHON" -c '
import os, signal, time
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
while True:
    if os.fork() == 0:
        while time.process_time() < 0.15: pass
        os._exit(0)
    try: os.wait()
    except ChildProcessError: pass'""",
}


@BOTH
@pytest.mark.parametrize("spin", SPIN.values(), ids=SPIN)
def test_cpu_time_of_all_processes_is_limited(make_runner, cgroups, spin):
    limits = Allowance(cpu_s=0.4, cgroups=cgroups)
    runner, entry = make_runner(spin, limits=limits)
    record = runner.run(entry).record
    assert record.result == TIMEOUT
    assert record.detail == "it used more than the limit of 0.4 s of CPU time"
    # Two cores for one interval between looks, and what it takes to end them.
    assert 0.4 < record.cpu_time < 1.2
    assert record.run_time < 30
    assert (record.limits.cpu_s.asked, record.limits.cpu_s.kept) == (0.4, 0.4)
    assert record.limits.cpu_s.by == record.measured_by.cpu_time


@BOTH
def test_answer_after_too_much_cpu_time_does_not_count(make_runner, cgroups):
    # It sleeps through no look: too short for one, but its own time tells in the end.
    spin = 'for i in {1..30000}; do :; done; echo unsat > "$RESULTS"'
    runner, entry = make_runner(spin, limits=Allowance(cpu_s=0.005, cgroups=cgroups))
    assert runner.run(entry).record.result == TIMEOUT


@BOTH
def test_memory_is_that_of_all_processes(make_runner, cgroups):
    run = (
        'for i in 1 2 3; do "$PYTHON" -c "import time; x = bytearray(b\'x\') * (60 << 20)\n'
        'time.sleep(0.6)" & done; wait; echo unsat > "$RESULTS"'
    )
    runner, entry = make_runner(run, limits=Allowance(cgroups=cgroups))
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert 180 < record.max_memory_mib < 300
    assert record.limits.memory_mib.asked is None


@BOTH
def test_shared_memory_counts_once(make_runner, cgroups):
    run = """exec "$PYTHON" -c '
import os, time
x = bytearray(b"x") * (150 << 20)
children = [os.fork() for _ in range(1)]
if 0 not in children:
    children.append(os.fork())
time.sleep(0.5)
if 0 not in children:
    for pid in children: os.waitpid(pid, 0)
    open(os.environ["RESULTS"], "w").write("unsat")'"""
    limits = Allowance(memory_mib=300, cgroups=cgroups)
    runner, entry = make_runner(f"export RESULTS; {run}", limits=limits)
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert 150 < record.max_memory_mib < 250


@BOTH
def test_tool_is_pinned_to_its_cores(make_runner, cgroups):
    core = max(os.sched_getaffinity(0))
    run = '"$PYTHON" -c "import os; print(os.sched_getaffinity(0))"; echo unsat > "$RESULTS"'
    runner, entry = make_runner(run, cores=[core], limits=Allowance(cgroups=cgroups))
    finished = runner.run(entry)
    assert finished.log.decode().strip() == f"{{{core}}}"
    assert finished.record.limits.cores.kept == [core]
    assert finished.record.limits.cores.by in ("cpuset", "affinity")


def test_cores_that_are_not_there_are_refused(make_runner):
    with pytest.raises(BadInput, match="cores 0, 4096: usable are "):
        make_runner("", cores=[0, 4096])


def test_limits_hold_in_prepare_instance_too(make_runner):
    runner, entry = make_runner("", prepare="yes", limits=Allowance(output_mib=1))
    record = runner.run(entry).record
    assert record.result == "prepare_instance_error_137"
    assert record.detail.startswith("prepare_instance.sh used more than the limit of 1 MiB of p")


def test_result_of_a_gigabyte_is_ended_by_default(make_runner):
    # Sparse, so that the disk is spared; a whole one is among the deeds above.
    run = 'echo unsat > "$RESULTS"; truncate -s 1100M "$RESULTS"; sleep 1000'
    runner, entry = make_runner(run)
    record = runner.run(entry).record
    assert record.result == KILLED
    assert (record.limits.output_mib.asked, record.limits.output_mib.kept) == (None, 1024)


def test_a_fresh_home_and_temporary_folders_lie_in_scratch(make_runner, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    show = 'printf "%s\\n" "$HOME" "$TMPDIR" "$TMP" "${XDG_CACHE_HOME-}"; ls -A "$HOME" "$TMPDIR"'
    runner, entry = make_runner(show, limits=Allowance(fresh_home=True))
    finished = runner.run(entry)
    home, *others = finished.log.decode().splitlines()
    temporary = [str(Path(home).with_name("tmp"))] * 2
    assert others == [*temporary, "", f"{home}:", "", f"{temporary[0]}:"]
    assert finished.record.limits.home == "fresh"
    runner.close()
    assert not Path(home).exists()


def test_home_is_the_users_own_by_default(make_runner):
    runner, entry = make_runner('echo "$HOME"')
    finished = runner.run(entry)
    assert finished.log.decode().strip() == os.environ["HOME"]
    assert finished.record.limits.home == "own"


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


def test_several_runners_at_once(benchmarks, make_tool, temporary, marker):
    names = [f"i{i}" for i in range(4)]
    for name in names:
        benchmarks.add(name, (0.25, 0.5), timeout=WALL)
    deed = (
        'case $ID in i0|i2) sleep 1000 ;; *) setsid -f sleep 1000; echo unsat > "$RESULTS" ;; esac'
    )
    tool = find_tool(str(make_tool(deed)))
    entries = select(benchmarks.root, ("quick",), ())
    records = {}

    def work(entry):
        with Runner(tool, benchmarks.root) as runner:
            records[entry.id] = runner.run(entry).record

    threads = [threading.Thread(target=work, args=(entry,)) for entry in entries]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {name: r.result for name, r in records.items()} == dict(
        zip(names, [TIMEOUT, "unsat", TIMEOUT, "unsat"], strict=True)
    )


def test_closing_takes_no_group_along(temporary):
    before = groups()
    with Supervisor():
        pass
    wait_until(lambda: groups() <= before)


def groups():
    """Return the control groups that were made by keepers which are gone."""
    found = set()
    for mount in psutil.disk_partitions(all=True):
        if mount.fstype in ("cgroup", "cgroup2"):
            for path in Path(mount.mountpoint).rglob("closedlap_*_*"):
                if not psutil.pid_exists(int(path.name.split("_")[1])):
                    found.add(path)
    return found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--memory-limit", "much"], "'much' is not a size; write 4096 (MiB), 16GB or 512MiB"),
        (["--memory-limit", "0"], "'0' is too small or too large for a limit"),
        (["--memory-limit", "-3"], "'-3' is not a size"),
        (["--scratch-limit", "1e400"], "is not a size"),
        (["--cpu-limit", "0"], "--cpu-limit"),
        (["--cpu-limit", "nan"], "--cpu-limit"),
    ],
)
def test_limits_that_are_none_are_refused(arguments, message):
    done = harness("run", "--tool", "simulate", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_sizes_have_units(benchmarks, make_tool, tmp_path, temporary):
    benchmarks.add("one", (0.25, 0.5))
    tool, out = make_tool('echo unsat > "$RESULTS"'), tmp_path / "run"
    sizes = ("--memory-limit", "2GB", "--output-limit", "0.5GiB", "--scratch-limit", "64")
    arguments = ("--tool", tool, "--benchmarks", benchmarks.root, "--out", out)
    assert harness("run", *arguments, *sizes).returncode == 0
    with RunFolder.open(out) as run:
        limits = run.record("one").limits
    assert limits.memory_mib.kept == pytest.approx(2e9 / 2**20)
    assert (limits.output_mib.kept, limits.scratch_mib.kept) == (512, 64)
    # A run is continued with the limits that it was begun with, or not at all.
    assert harness("run", *arguments, *sizes, "--resume").returncode == 0
    done = harness("run", *arguments, *sizes[:4], "--scratch-limit", "65", "--resume")
    assert done.returncode == 2
    assert "begun with another --scratch-limit (MiB) (64.0, now 65.0)" in done.stderr


def test_a_wall_limit_is_kept_while_scratch_is_looked_at(make_runner):
    # Thousands of files: a look takes long, and must not hold up the end.
    run = "mkdir a; cd a; for i in {1..3000}; do : > $i; done; sleep 1000"
    runner, entry = make_runner(run, timeout=1.0, limits=Allowance(scratch_mib=500))
    start = time.monotonic()
    record = runner.run(entry).record
    assert record.result == TIMEOUT
    assert record.run_time < 1.5
    assert time.monotonic() - start < 4
