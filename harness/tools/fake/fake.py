"""The tool ``fake``: does what FAKE_ANSWERS or FAKE_ANSWER says (about.toml explains).

Only the standard library is imported, and little of it: the start of this process is part
of what tests of overhead measure.
"""

import json
import os
import sys
import time


def entry(spec: str) -> dict:
    """Return what to do for an instance."""
    if told := os.environ.get("FAKE_ANSWER"):
        return json.loads(told)
    with open(os.environ["FAKE_ANSWERS"], encoding="utf-8") as file:  # noqa: PTH123
        answers = json.load(file)
    name = os.path.splitext(os.path.basename(spec))[0]  # noqa: PTH119, PTH122
    return answers.get(name, answers.get("*", {}))


def end(status: int, signal: int | None = None) -> None:
    """End this process as told."""
    sys.stdout.flush()
    if signal is not None:
        os.kill(os.getpid(), signal)
    sys.exit(status)


def main(action: str, spec: str, results: str | None) -> None:
    """Take one step."""
    told = entry(spec)
    if action == "prepare":
        time.sleep(told.get("prepare_delay", 0))
        end(told.get("prepare_status", 0))
    sys.stdout.write("." * told.get("print", 0))
    time.sleep(told.get("delay", 0))
    if results is not None and not told.get("silent", False):
        with open(results, "w", encoding="utf-8") as file:  # noqa: PTH123
            file.write(f"{told.get('answer', 'unknown')}\n{told.get('witness', '')}")
    end(told.get("status", 0), told.get("signal"))


if __name__ == "__main__":
    # fake.py prepare|run v1 CATEGORY ONNX SPEC [RESULTS TIMEOUT]
    main(sys.argv[1], sys.argv[5], sys.argv[6] if len(sys.argv) > 6 else None)
