import csv
import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from click.testing import CliRunner
from vnnlib_reader import Read

from generator.cli import main
from generator.emit import load_controllers
from generator.gzipped import gzipped
from generator.openloop.part import Asked
from generator.vnncomp import BUDGET, choose, export_vnncomp, generate_properties
from racecar.errors import BadInput

CATEGORIES = ("open_loop", "unrolled")


@pytest.fixture(scope="module")
def root(tmp_path_factory, add_controller):
    root = tmp_path_factory.mktemp("root")
    add_controller(root)
    chosen = [part for name in CATEGORIES for part in ("--category", name)]
    assert CliRunner().invoke(main, ["emit", "--root", str(root), *chosen]).exit_code == 0
    return root


@pytest.fixture
def exported(root, tmp_path):
    export_vnncomp(root, tmp_path, load_controllers(root))
    return tmp_path / "benchmarks"


def contents(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def check_benchmark(folder):
    """The layout of VNN-COMP 2026; returns the rows of its tables."""
    tables = {}
    for version in ("1.0", "2.0"):
        here = folder / version
        rows = list(csv.reader((here / "instances.csv").read_text().splitlines()))
        assert rows
        networks, specs = {row[0] for row in rows}, {row[1] for row in rows}
        assert len(specs) == len(rows)
        assert {p.relative_to(here).as_posix() for p in here.rglob("*.gz")} == {
            f"{path}.gz" for path in networks | specs
        }
        for network, spec, timeout in rows:
            assert Path(network).parent == Path("onnx")
            assert Path(spec).parent == Path("vnnlib")
            assert int(timeout) > 0
        network, spec, _ = rows[len(rows) // 2]
        read = Read(gzip.decompress((here / f"{spec}.gz").read_bytes()).decode())
        content = gzip.decompress((here / f"{network}.gz").read_bytes())
        session = onnxruntime.InferenceSession(content)
        x = np.zeros((1, read.inputs), dtype=np.float32)
        (y,) = session.run(None, {session.get_inputs()[0].name: x})
        assert y.shape == (1, read.outputs)
        tables[version] = rows
    assert tables["1.0"] == tables["2.0"]
    return tables["1.0"]


def test_the_export_has_the_published_layout_and_holds_what_was_emitted(root, exported):
    for category in CATEGORIES:
        folder = exported / f"closedlap_{category}"
        rows = check_benchmark(folder)
        emitted = csv.reader(
            (root / "benchmarks" / category / "instances.csv").read_text().splitlines()
        )
        for (network, spec, timeout), (onnx, listed, seconds) in zip(rows, emitted, strict=True):
            assert Path(network).name == Path(onnx).name
            assert Path(spec).name == Path(listed).name
            assert timeout == seconds
            emitted_spec = (root / "benchmarks" / category / f"{listed}.gz").read_bytes()
            assert (folder / "1.0" / f"{spec}.gz").read_bytes() == emitted_spec
        assert (folder / "controllers" / "TD3_L5_8_C1.onnx.gz").exists()


def test_the_same_files_are_compressed_to_the_same_bytes(root, exported, tmp_path):
    export_vnncomp(root, tmp_path / "again", load_controllers(root))
    assert contents(tmp_path / "again" / "benchmarks") == contents(exported)
    packed = gzipped(b"abc" * 100)
    assert gzip.decompress(packed) == b"abc" * 100
    assert packed[4:8] == bytes(4)  # no time
    assert packed[3] == 0  # no name


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_seed_makes_a_new_competition_set_the_same_every_time(exported, category):
    folder = exported / f"closedlap_{category}"
    sets = {}
    for seed in (7, 8):
        count = generate_properties(folder, category, seed).instances
        rows = check_benchmark(folder)
        assert len(rows) == count
        assert sum(int(row[2]) for row in rows) <= BUDGET == 6 * 3600
        assert all(f".seed{seed}." in row[1] for row in rows)
        sets[seed] = contents(folder)
    assert sets[7].keys() != sets[8].keys()
    # Once more by the script, as an organiser does it.
    command = [sys.executable, folder / "generate_properties.py", "7"]
    said = subprocess.run(command, check=True, cwd=exported, stdout=subprocess.PIPE, text=True)
    assert said.stdout.partition(" ")[0].isdecimal()
    assert contents(folder) == sets[7]


def test_a_seed_must_be_a_number(exported):
    script = exported / "closedlap_open_loop" / "generate_properties.py"
    for arguments in ([], ["x"], ["1", "2"]):
        result = subprocess.run(
            [sys.executable, script, *arguments], capture_output=True, text=True, check=False
        )
        assert result.returncode == 1
        assert result.stderr.startswith("usage: ")


def test_a_choice_keeps_the_budget_the_order_and_all_that_fits():
    asked = [Asked(str(i), "net", 100 + i) for i in range(300)]
    kept = choose(asked, 3, 5000)
    spent = sum(a.timeout for a in kept)
    assert 5000 - 100 < spent <= 5000
    assert kept == sorted(kept, key=lambda a: int(a.id))
    assert kept == choose(asked, 3, 5000)
    assert kept != choose(asked, 4, 5000)
    assert choose(asked[:3], 0) == asked[:3]


def test_what_is_missing_or_in_the_way_is_said_in_a_line(root, exported, tmp_path):
    controllers = load_controllers(root)
    with pytest.raises(BadInput, match="is there already"):
        export_vnncomp(root, exported.parent, controllers)
    with pytest.raises(BadInput, match="no VNN-LIB form"):
        export_vnncomp(root, tmp_path / "a", controllers, ["closed_loop"])
    with pytest.raises(BadInput, match=r"instances\.csv: cannot be read"):
        export_vnncomp(tmp_path, tmp_path / "b", controllers, ["open_loop"])
    (exported / "closedlap_open_loop" / "controllers" / "TD3_L5_8_C1.onnx.gz").write_bytes(b"x")
    with pytest.raises(BadInput, match="gzip"):
        generate_properties(exported / "closedlap_open_loop", "open_loop", 1)
