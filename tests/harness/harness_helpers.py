"""A small benchmarks folder, and looking after processes."""

import contextlib
import hashlib
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest
from click.testing import CliRunner

from harness.cli import main
from harness.store import RunFolder
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, Layer, save_controller
from racecar.instance import (
    ControllerReference,
    InitialSet,
    Instance,
    plant_data,
    property_data,
    save_instance,
)
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track

#: Straight ahead for 2 s from the middle of the hall: nothing is near. For 7 s: into the wall.
SHORT, LONG = 20, 70
POINT = (0.0, 0.0)
#: Seconds in which a busy machine does what an idle one does in a fraction of one. Far below how
#: long the tools of the tests would go on; how exactly a limit is kept, bench/kills.py measures.
SOON = 30.0


#: Codes of a tool that takes too long, and of one that takes too much.
TIMEOUT, KILLED = "run_instance_timeout", "error_exit_code_137"
#: With control groups, where they work, and without.
BOTH = pytest.mark.parametrize("cgroups", [True, False], ids=["cgroups", "fallback"])


def straight_controller(bias=0.0):
    """A controller that holds one steering angle (rad)."""
    layer = Layer(np.zeros((1, 21), np.float32), np.array([bias], np.float32), "linear")
    return Controller((layer,))


@dataclass
class Benchmarks:
    """A benchmarks folder under construction, with one controller beside it."""

    folder: Path
    rows: dict = field(default_factory=dict)

    @property
    def root(self):
        return self.folder / "benchmarks"

    @property
    def onnx(self):
        return self.folder / "onnx" / "straight.onnx"

    def add(
        self,
        name,
        s=(0.65, 0.85),
        steps=SHORT,
        category="quick",
        timeout=10.0,
        disturbance=None,
        **box,
    ):
        """Add an instance and return its file."""
        if not self.onnx.exists():
            save_controller(straight_controller(), self.onnx)
        plant = Plant(square_track(), Bicycle(), Lidar())
        spec = self.root / category / "json" / f"{name}.json"
        instance = Instance(
            id=name,
            category=category,
            controller=ControllerReference(
                name="straight",
                file="../../../onnx/straight.onnx",
                sha256=hashlib.sha256(self.onnx.read_bytes()).hexdigest(),
            ),
            plant=plant_data(plant),
            initial_set=InitialSet(**{"s": s, "f": (9.9, 9.9), "v": POINT, "theta": POINT, **box}),
            disturbance=disturbance,
            steps=steps,
            property=property_data(named_property("clearance", plant.track)),
        )
        save_instance(instance, spec)
        self.rows.setdefault(category, []).append(
            f"../../onnx/straight.onnx,json/{name}.json,{timeout:g}\n"
        )
        (self.root / category / "instances.csv").write_text("".join(self.rows[category]))
        return spec

    def set_references(self, rows, category="quick"):
        """Write the reference results: (instance, verdict, margin_lower, margin_upper)."""
        lines = ["instance,verdict,margin_lower,margin_upper,time_s", *(f"{r},1.5" for r in rows)]
        (self.root / category / "reference.csv").write_text("\n".join(lines) + "\n")


def carriers(word):
    """Return the other living processes that carry a word in their environment."""
    found = []
    for process in psutil.process_iter():
        try:
            alive = process.pid != os.getpid() and process.status() != psutil.STATUS_ZOMBIE
            if alive and process.environ().get("HARNESS_TEST_MARKER") == word:
                found.append((process.pid, process.cmdline()))
        except psutil.Error:
            continue
    return found


@dataclass(frozen=True)
class Done:
    """How a command line ended."""

    returncode: int
    stdout: str
    stderr: str


def harness(*arguments, cwd=None):
    """Run the command line within this process."""
    runner = CliRunner()
    with contextlib.chdir(cwd or Path.cwd()):
        result = runner.invoke(main, [str(x) for x in arguments], prog_name="harness")
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


def harness_process(*arguments, cwd=None):
    """Run the command line as a process of its own."""
    command = [sys.executable, "-m", "harness", *map(str, arguments)]
    done = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, timeout=300, check=False
    )
    return Done(done.returncode, done.stdout, done.stderr)


def wait_until(condition, seconds=SOON):
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up, "it did not happen in time"
        time.sleep(0.01)


def ulps_above(x, count=1):
    for _ in range(count):
        x = math.nextafter(x, math.inf)
    return x


def log_of(run, instance):
    """What a tool printed on an instance of a run, as text."""
    with RunFolder.open(run) as folder:
        return folder.log(folder.record(instance)).decode()
