"""Real verifiers for tests: those that ship with the harness, installed as it installs them.

A test skips where a tool cannot be installed; slow ones (hundreds of megabytes, minutes to
run) are used only with CLOSEDLAP_SLOW_TOOLS=1.
"""

import os
import subprocess

import pytest

from harness.environments import ensure_environment
from harness.tool import find_tool
from racecar.errors import BadInput

#: Those that take minutes.
SLOW = ("vibecheck", "neuralsat")


def installed(name):
    """Return the folder with the programs of a shipped tool; skip where it cannot be had."""
    if name in SLOW and os.environ.get("CLOSEDLAP_SLOW_TOOLS") != "1":
        pytest.skip(f"{name} is slow; set CLOSEDLAP_SLOW_TOOLS=1 to test with it")
    packages = find_tool(name).description.install.packages
    try:
        return ensure_environment(name, packages, 1800) / "bin"
    except BadInput as error:
        pytest.skip(f"{name} cannot be installed here: {error}")


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
    program, results = installed("vibecheck") / "vibecheck", folder / "results.txt"
    options = ("--timeout", timeout, "--device", "cpu", "--results-file", results)
    text = run(program, "--net", network, "--spec", spec, *options, cwd=folder, timeout=3 * timeout)
    assert results.exists(), text
    return results.read_text().splitlines()[0]


def marabou(network, spec, folder, timeout=20):
    """Return Marabou's verdict: sat, unsat, TIMEOUT or UNKNOWN."""
    program, summary = installed("marabou") / "Marabou", folder / "summary.txt"
    options = ("--timeout", timeout, "--verbosity", 0, "--summary-file", summary)
    text = run(program, network, spec, *options, cwd=folder, timeout=3 * timeout)
    assert summary.exists(), text
    return summary.read_text().split()[0]
