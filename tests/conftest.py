"""What tests share: a Hypothesis profile, the paper's track and controllers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hypothesis
import pytest
import yaml

from generator.actor import fold
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller
from racecar.lidar import Lidar
from racecar.track import Track, square_track

# Shared machines are slow now and then; tests are to fail for what they test.
hypothesis.settings.register_profile("closedlap", deadline=None)
hypothesis.settings.load_profile("closedlap")

PAPER_CONTROLLERS = Path(__file__).parents[1].parent / "shared" / "paper_controllers"


@pytest.fixture(scope="session")
def square() -> Track:
    return square_track()


@pytest.fixture(scope="session")
def plant(square: Track) -> Plant:
    """Return the paper's plant: square, no slip, 21 rays."""
    return Plant(square, Bicycle(), Lidar())


@pytest.fixture(scope="session")
def paper_controller() -> Callable[[str], Controller]:
    """Return a reader of the paper's controllers; the test skips where they are absent."""

    def read(name: str) -> Controller:
        path = PAPER_CONTROLLERS / f"{name}.yml"
        if not path.exists():
            pytest.skip("the paper's controllers are not beside the repository")
        data = yaml.safe_load(path.read_text())
        layers = [
            (data["weights"][i], data["offsets"][i], data["activations"][i].lower())
            for i in sorted(data["weights"])
        ]
        return fold(layers, {})

    return read
