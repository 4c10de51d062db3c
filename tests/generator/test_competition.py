"""Competition sets: benchmarks/generate_properties.py SEED."""

import csv
import gzip
import importlib.util
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from harness.catalogue import category_names, load_category, load_references

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "generate_properties.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("generate_properties", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode, kept = True, sys.dont_write_bytecode
    sys.modules["generate_properties"] = module
    spec.loader.exec_module(module)
    sys.dont_write_bytecode = kept
    yield module
    del sys.modules["generate_properties"]


@pytest.fixture(scope="module")
def committed(script):
    """The committed instances, graded."""
    return script.load(SCRIPT.parent)


@pytest.fixture
def dataset(tmp_path):
    """dataset(category, {instance: (timeout, verdict and time or None, size)}) adds a category."""

    def add(category, instances):
        folder = tmp_path / "benchmarks" / category
        (folder / "json").mkdir(parents=True)
        rows, results = [], ["instance,verdict,margin_lower,margin_upper,time_s"]
        for name, (timeout, result, steps) in instances.items():
            rows.append(f"../../onnx/n.onnx,json/{name}.json,{timeout}\n")
            instance = {
                "plant": {"lidar": {"rays": 5}},
                "steps": steps,
                "initial_set": {"s": [0.65, 0.85]},
            }
            (folder / "json" / f"{name}.json").write_text(json.dumps(instance))
            if result:
                results.append(f"{name},{result[0]},,,{result[1]}")
        (folder / "instances.csv").write_text("".join(rows))
        if len(results) > 1:
            (folder / "reference.csv").write_text("\n".join(results) + "\n")
        return tmp_path / "benchmarks"

    return add


def test_a_set_needs_nothing_but_python_and_lists_files_that_are_there(tmp_path, committed):
    out = tmp_path / "set"
    # Neither this package nor any other can be imported.
    command = [sys.executable, "-I", "-S", SCRIPT, "7", out]
    said = subprocess.run(command, check=True, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert category_names(out) == category_names(SCRIPT.parent)
    ids, seconds = [], 0
    for category in category_names(out):
        listed = {entry.id for entry in load_category(SCRIPT.parent, category)}
        for entry in load_category(out, category):  # all its files are there
            assert entry.id in listed
            ids.append(entry.id)
            seconds += entry.timeout
    assert len(ids) == len(set(ids))
    assert seconds < 21_600
    assert said.stdout.startswith(f"{len(ids)} instances, timeouts of {seconds:.0f} s in all")
    with (out / "grades.csv").open(newline="") as file:
        grades = list(csv.DictReader(file))
    assert [row["instance"] for row in grades] == ids
    assert {name: row for name, row in load_references(SCRIPT.parent).items() if name in ids} == (
        load_references(out)
    )
    there, chosen = defaultdict(set), defaultdict(set)
    for category, instances in committed.items():
        there[category] = {instance.grade for instance in instances}
    for row in grades:
        chosen[row["category"]].add(row["grade"])
    assert chosen == there
    assert sum(there[name] == {"easy", "medium", "open"} for name in there) >= 5


def test_a_seed_gives_the_same_set_again_and_another_seed_another(script, committed, tmp_path):
    sets = {}
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        chosen = script.choose(committed, seed)
        assert sum(instance.timeout for instance in chosen) < script.BUDGET == 21_600
        script.write(chosen, SCRIPT.parent, tmp_path / name)
        sets[name] = {
            path.relative_to(tmp_path / name): path.read_bytes()
            for path in (tmp_path / name).rglob("*.csv")
        }
    assert sets["a"] == sets["b"]
    assert sets["a"].keys() == sets["c"].keys()
    assert sum(sets["a"][name] != sets["c"][name] for name in sets["a"]) > len(sets["a"]) / 2


def test_grades_follow_the_reference_and_else_the_structure(script, dataset):
    dataset("decided", {"a": (10, ("unsat", 1), 9), "b": (10, ("sat", 2), 1),
                        "c": (10, ("unsat", 7), 1), "d": (10, ("unknown", 0.5), 1)})  # fmt: skip
    root = dataset("asked", {"e": (10, None, 3), "f": (10, None, 1), "g": (10, None, 2)})
    graded = {
        instance.id: (instance.grade, instance.by)
        for instances in script.load(root).values()
        for instance in instances
    }
    assert graded == {
        "a": ("easy", "reference"),
        "b": ("easy", "reference"),
        "c": ("medium", "reference"),
        "d": ("open", "reference"),
        "f": ("easy", "structure"),
        "g": ("medium", "structure"),
        "e": ("open", "structure"),
    }


def test_what_follows_from_a_larger_question_takes_its_time(script, dataset):
    root = dataset("whole", {"fast": (10, ("unsat", 2), 1), "slow": (10, ("unsat", 90), 1)})
    dataset("parts", dict.fromkeys(("a", "b", "c"), (10, ("unsat", ""), 1)))
    (root / "parts" / "reference.csv").write_text(
        "instance,verdict,margin_lower,margin_upper,source,time_s\n"
        "a,unsat,,,fast,\nb,unsat,,,slow,\nc,unsat,,,c,3\n"
    )
    assert {x.id: x.grade for x in script.load(root)["parts"]} == {
        "a": "easy", "b": "medium", "c": "easy",
    }  # fmt: skip


def test_questions_of_one_size_are_all_easy_and_packed_ones_are_read(script, dataset, tmp_path):
    root = dataset("flat", {"a": (10, None, 1), "b": (10, None, 1), "c": (10, None, 1)})
    assert [x.grade for x in script.load(root)["flat"]] == ["easy"] * 3
    folder = root / "queries"
    folder.mkdir()
    for name, size in (("x", 10), ("y", 500)):
        (folder / f"{name}.vnnlib.gz").write_bytes(gzip.compress(b" " * size))
    (folder / "instances.csv").write_text("n,x.vnnlib,5\nn,y.vnnlib,5\n")
    assert [x.grade for x in script.load(root)["queries"]] == ["easy", "medium"]


def test_every_category_has_its_part_and_takes_its_grades_in_turn(script, dataset):
    many = {
        f"{grade}{i}": (10, ("unknown" if grade == "o" else "sat", 1 + (grade == "m")), 1)
        for grade in "emo"
        for i in range(40)
    }
    dataset("many", many)
    root = dataset("few", {"alone": (100, ("unsat", 3), 1)})
    chosen = script.choose(script.load(root), 5, budget=401)
    # 200 s each; what `few` does not need, `many` gets.
    assert sorted(x.id for x in chosen if x.category == "few") == ["alone"]
    grades = [x.grade for x in chosen if x.category == "many"]
    assert len(grades) == 30
    assert {grade: grades.count(grade) for grade in set(grades)} == dict.fromkeys(script.GRADES, 10)


@pytest.mark.parametrize("arguments", [[], ["x"], ["-1"], ["1", "a", "b"], ["1", SCRIPT.parent]])
def test_bad_arguments_give_one_line_and_status_2(arguments):
    done = subprocess.run(
        [sys.executable, SCRIPT, *arguments], check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
