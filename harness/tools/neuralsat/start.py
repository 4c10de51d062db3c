"""Start NeuralSAT's main.py as a program (its package has none); arguments are passed on."""

import contextlib
import runpy
import sys
import types
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """Run main.py of the installed package ``src``, which imports its neighbours by bare names."""
    with contextlib.suppress(Exception):
        import torchvision  # noqa: F401, PLC0415
    if "torchvision" not in sys.modules:
        # Its wheel needs CUDA's libraries. Only the operator NonMaxSuppression uses it, and fails
        # on this empty module.
        for name in [name for name in sys.modules if name.startswith("torchvision.")]:
            del sys.modules[name]
        sys.modules["torchvision"] = types.ModuleType("torchvision")
    package = find_spec("src")
    if package is None or not package.submodule_search_locations:
        sys.exit("NeuralSAT is not installed in this environment")
    folder = Path(next(iter(package.submodule_search_locations)))
    sys.path.insert(0, str(folder))
    sys.argv[0] = str(folder / "main.py")
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
