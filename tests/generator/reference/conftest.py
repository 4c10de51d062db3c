import shutil

import pytest


@pytest.fixture
def copied(made, tmp_path):
    """A copy of what a test module has made, a root and its work folder, to be changed."""
    for source, name in zip(made, ("root", "work"), strict=True):
        shutil.copytree(source, tmp_path / name)
    return tmp_path / "root", tmp_path / "work"
