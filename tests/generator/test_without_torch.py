"""Everything but training works, and training explains itself, without the extra."""

import json
import subprocess
import sys

import pytest

HIDE = """
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "stable_baselines3"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
"""


def run(*arguments):
    code = HIDE + f"sys.argv = {['generator', *arguments]!r}\n"
    code += "from generator.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )


def test_training_says_what_to_install(tmp_path):
    result = run("train", "TD3_L5_8x8_C1", "--work", str(tmp_path / "w"), "--out", str(tmp_path))
    assert result.returncode == 2
    assert result.stderr.startswith("error: training needs the package ")
    assert "pip install -e '.[train]'" in result.stderr
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_emit_does_not_need_the_extra(tmp_path, add_controller):
    add_controller(tmp_path)
    result = run("emit", "--root", str(tmp_path), "--category", "full_range", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["instances"] == 2


@pytest.mark.parametrize("module", ["torch", "stable_baselines3", "matplotlib", "onnxruntime"])
def test_starting_the_command_imports_nothing_heavy(module):
    code = f"import generator.cli, sys; sys.exit({module!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
