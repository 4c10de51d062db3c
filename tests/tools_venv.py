"""Real verifiers for tests, each in its own virtual environment, made once and kept.

They lie in ~/.cache/closedlap/tools/NAME-VERSION. A test skips where a tool cannot be installed;
slow ones (gigabytes to download, minutes to run) are used only with CLOSEDLAP_SLOW_TOOLS=1.
"""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

CACHE = Path.home() / ".cache" / "closedlap" / "tools"
CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
_DONE = "installed"


def tool(package, version, program, slow=False):
    """Return the path of a program of a package; skip where it cannot be had."""
    folder = CACHE / f"{package}-{version}"
    if slow and os.environ.get("CLOSEDLAP_SLOW_TOOLS") != "1":
        pytest.skip(f"{package} is slow; set CLOSEDLAP_SLOW_TOOLS=1 to test with it")
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / f"{package}-{version}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # tests run side by side
        if not (folder / _DONE).exists():
            _install(folder, f"{package}=={version}")
            (folder / _DONE).touch()
    return folder / "bin" / program


def _install(folder, requirement):
    pip = [folder / "bin" / "python", "-m", "pip", "install", "-q", "-c", CONSTRAINTS, requirement]
    for command in ([sys.executable, "-m", "venv", "--clear", folder], pip):
        result = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)
        if result.returncode:
            reason = (result.stderr.strip() or "no message").splitlines()[-1]
            pytest.skip(f"{requirement} cannot be installed here: {reason}")


def run(*command, cwd, timeout):
    """Run a tool on one core; return its standard output and error together."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    result = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        timeout=timeout,
        env=os.environ | one,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    return result.stdout


def vibecheck(network, spec, folder, timeout=60):
    """Return vibecheck's verdict."""
    program, results = tool("vibecheck-nn", "1.1.0", "vibecheck", slow=True), folder / "results.txt"
    options = ("--timeout", timeout, "--device", "cpu", "--results-file", results)
    text = run(program, "--net", network, "--spec", spec, *options, cwd=folder, timeout=3 * timeout)
    assert results.exists(), text
    return results.read_text().splitlines()[0]


def marabou(network, spec, folder, timeout=20):
    """Return Marabou's verdict: sat, unsat, TIMEOUT or UNKNOWN."""
    program, summary = tool("maraboupy", "2.0.0", "Marabou"), folder / "summary.txt"
    options = ("--timeout", timeout, "--verbosity", 0, "--summary-file", summary)
    text = run(program, network, spec, *options, cwd=folder, timeout=3 * timeout)
    assert summary.exists(), text
    return summary.read_text().split()[0]
