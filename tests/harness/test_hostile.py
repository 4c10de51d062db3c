"""Hostile tools: each gets its code, leaves nothing behind and spoils no other result."""

import csv
import json
import os

import pytest
from harness_helpers import KILLED, SOON, TIMEOUT, carriers, harness_process

from harness.records import Record
from harness.store import RunFolder

#: Limits of the whole run (MiB), and time (s) for those that are to run into it.
MEMORY, OUTPUT, SCRATCH, WALL = 400, 16, 24, 0.5

NONE = "no_result_in_file"
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
            assert WALL < record.run_time < SOON, name
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
