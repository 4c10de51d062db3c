"""The checker is a second opinion: it imports nothing of what it checks, nor of what judges."""

import ast
from pathlib import Path

import checker

OTHERS = {"verifier", "harness", "generator", "racecar", "leaderboard"}


def test_the_checker_imports_none_of_the_other_packages():
    files = sorted(Path(checker.__file__).parent.rglob("*.py"))
    assert len(files) > 10
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not OTHERS & {name.split(".")[0] for name in names}, file
