"""A site of three made-up tools on real instances, with one real certificate."""

import pytest
from site_helpers import STRAIGHT, build, leaderboard, write_contest


@pytest.fixture(scope="session")
def contest(tmp_path_factory):
    return write_contest(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def certificates(contest, tmp_path_factory):
    """Return a folder with the certificate of STRAIGHT, made by the reference verifier."""
    folder = tmp_path_factory.mktemp("certificates")
    done = leaderboard("certificates", contest / "beta", "-o", folder)
    assert done.returncode == 0, done.stderr
    assert (folder / f"{STRAIGHT}.h5").is_file()
    return folder


@pytest.fixture(scope="session")
def site(contest, certificates, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "site"
    build(contest, "-o", folder, "--certificates", certificates)
    return folder
