"""The hybrid files in the emitted tree: complete, and the same as exported ones."""

import gzip
import io
import json
import shutil
import tarfile

import jsonschema
import pytest
from click.testing import CliRunner
from hybrid_readers import read_flowstar, read_json, read_spaceex

from generator.categories import CATEGORIES
from generator.cli import main
from generator.emit import build, load_controllers
from generator.hybrid.export import FORMATS, hybrid_files
from generator.hybrid.part import Packing, hybrid_part
from generator.instances import ControllerFile, Question, make_instance
from racecar.disturbance import Disturbance
from racecar.instance import load_instance, load_instance_controller

NAME = "TD3_L5_8_C1"


@pytest.fixture(scope="module")
def root(tmp_path_factory, add_controller):
    root = tmp_path_factory.mktemp("root")
    add_controller(root)
    names = ("closed_loop", "full_range", "state_box")
    chosen = [part for name in names for part in ("--category", name)]
    assert CliRunner().invoke(main, ["emit", "--root", str(root), *chosen]).exit_code == 0
    return root / "benchmarks"


def unpacked(path):
    """Return the content; pickles are no text, so all is read byte by byte."""
    return gzip.decompress(path.read_bytes()).decode("latin-1")


def archived(root, category, form):
    """Return the members of the archive of a category."""
    content = gzip.decompress((root / category / form / f"{NAME}.tar.gz").read_bytes())
    with tarfile.open(fileobj=io.BytesIO(content)) as file:
        assert all(x.mtime == x.uid == x.gid == 0 and not x.uname for x in file.getmembers())
        return {name: file.extractfile(name).read().decode("latin-1") for name in file.getnames()}


def exported(root, category, id):
    path = root / category / "json" / f"{id}.json"
    instance = load_instance(path)
    controller = load_instance_controller(instance, path)
    files = {form: hybrid_files(instance, controller, form, zipped=False) for form in FORMATS}
    return {
        ending: text.decode("latin-1") for one in files.values() for ending, text in one.items()
    }


def without_comment(text):
    """Leave out the lines that name the instance; they lie elsewhere in joined files."""
    return [x for x in text.splitlines() if not x.startswith(("# ", "<!-- "))]


def check(root, category, id, own):
    """own(format, name) returns the text of an own file."""
    wanted, shared = exported(root, category, id), root / "full_range"
    head = unpacked(shared / "flowstar" / f"{NAME}.k70.model.head.gz")
    whole = head + own("flowstar", f"{id}.model.tail")
    assert without_comment(whole) == without_comment(wanted[".model"])
    assert read_flowstar(whole) == read_flowstar(wanted[".model"])
    xml = unpacked(shared / "spaceex" / f"{NAME}.k70.xml.gz")
    cfg = own("spaceex", f"{id}.cfg")
    assert cfg == wanted[".cfg"]
    assert read_spaceex(xml, cfg) == read_spaceex(wanted[".xml"], wanted[".cfg"])
    for kind in (".network.yml", ".plant.pickle", ".glue.pickle", ".plant.json", ".glue.json"):
        path = shared / "verisig" / f"{NAME}.k70{kind}.gz"
        assert unpacked(path) == wanted[kind]
    assert own("verisig", f"{id}.problem.json") == wanted[".problem.json"]
    # What the documentation says: the question's values in the place of the file's.
    data = json.loads(unpacked(shared / "automaton" / f"{NAME}.k70.automaton.json.gz"))
    question = json.loads(own("automaton", f"{id}.question.json"))
    for variable in data["variables"]:
        variable["initial"] = question["initial"].get(variable["name"], variable["initial"])
    data |= {key: question[key] for key in ("id", "description", "unsafe")}
    assert data == json.loads(wanted[".automaton.json"])
    schema = json.loads((root / "automaton.schema.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(data)


@pytest.mark.parametrize("safety", ["clearance", "hscc20"])
def test_shared_and_own_files_make_the_files_of_a_full_range_instance(root, safety):
    folder = root / "full_range"
    check(
        root,
        "full_range",
        f"{NAME}.full_range.{safety}",
        lambda form, name: unpacked(folder / form / f"{name}.gz"),
    )


@pytest.mark.parametrize(
    ("category", "tried"),
    [
        ("closed_loop", ("w5mm.000", "w1mm.199")),
        ("state_box", ("turn.s5mm.f5mm.v10mmps.h0.2deg",)),
    ],
)
def test_with_the_archives_they_make_those_of_other_categories(root, category, tried):
    forms = ("flowstar", "spaceex", "automaton", "verisig")
    members = {form: archived(root, category, form) for form in forms}
    ids = {path.stem for path in (root / category / "json").iterdir()}
    for names in members.values():
        assert {name.split(".clearance")[0] + ".clearance" for name in names} == ids
    for label in tried:
        id = f"{NAME}.{category}.{label}.clearance"
        check(root, category, id, lambda form, name: members[form][name])


def test_gzip_files_laid_one_after_the_other_are_a_gzip_file(root):
    folder = root / "full_range" / "flowstar"
    parts = [
        folder / f"{NAME}.k70.model.head.gz",
        folder / f"{NAME}.full_range.clearance.model.tail.gz",
    ]
    joined = b"".join(path.read_bytes() for path in parts)
    assert read_flowstar(gzip.decompress(joined).decode()).initial["s"] == (0.65, 0.85)


def test_quick_instances_are_whole(tmp_path, add_controller):
    add_controller(tmp_path, "TD3_L21_64x64_C1", rays=21)
    emitted = build(tmp_path, [CATEGORIES["quick"]], load_controllers(tmp_path))
    for path, content in emitted.tree.items():
        target = tmp_path / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    folder = tmp_path / "benchmarks" / "quick"
    ids = [path.stem for path in (folder / "json").iterdir()]
    assert len(ids) >= 5
    wanted = exported(folder.parent, "quick", ids[0])
    for form in ("flowstar", "spaceex", "automaton", "verisig"):
        for id in ids:
            assert list((folder / form).glob(f"{id}.*.gz"))
    for ending, text in wanted.items():
        (path,) = folder.glob(f"*/{ids[0]}{ending}.gz")
        assert unpacked(path) == text
    read_json(unpacked(folder / "automaton" / f"{ids[0]}.automaton.json.gz"))


def test_what_a_format_cannot_say_is_left_out(tmp_path, add_controller):
    file = ControllerFile.load(add_controller(tmp_path))
    noise = Disturbance(noise=0.01, missing=0, turn_only=False, choice="run")
    question = Question("A.noise", "noise", ("0.7", "0.8"), steps=2, disturbance=noise)
    instance = make_instance(question, file, 4.0, tmp_path / "x.json")
    tree = hybrid_part(Packing.WHOLE, file, [instance])
    assert {path.split("/")[0] for path in tree} == {"flowstar", "spaceex", "automaton"}
    calm = make_instance(Question("A.calm", "noise", "0.7"), file, 4.0, tmp_path / "x.json")
    both = hybrid_part(Packing.WHOLE, file, [instance, calm])
    assert tree.items() <= both.items()
    assert {path.split("/")[1].split(".")[1] for path in both if "verisig" in path} == {"calm"}


@pytest.mark.parametrize(
    ("name", "rays", "printed"),
    [
        ("TD3_L61_8_C1", 61, {"full_range"}),
        ("TD3_L61_8_C2", 61, set()),  # differs in weights only
        ("TD3_L62_8_C1", 62, set()),
        ("TD3_L3200_8_C1", 3200, {"full_scan"}),  # 25,600 weights
        ("TD3_L10001_8_C1", 10001, set()),
    ],
)
def test_large_controllers_and_further_seeds_are_left_out(
    tmp_path, make_controller, name, rays, printed
):
    file = ControllerFile(tmp_path / f"{name}.onnx", b"", make_controller(rays))
    assert {
        category
        for category in ("full_range", "full_scan")
        if CATEGORIES[category].asks(rays) and CATEGORIES[category].printed(file)
    } == printed


def test_a_check_compares_what_is_compressed(tmp_path, root):
    shutil.copytree(root.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "benchmarks/full_range/spaceex" / f"{NAME}.k70.xml.gz"
    options = ["--root", str(tmp_path / "copy"), "--check", "--json", "--category", "full_range"]
    content = gzip.decompress(path.read_bytes())
    # Packed by another zlib: the manifest knows the bytes, the content is right.
    path.write_bytes(gzip.compress(content, 1))
    result = CliRunner().invoke(main, ["emit", *options])
    assert json.loads(result.stdout)["differ"] == ["benchmarks/manifest.json"]
    path.write_bytes(gzip.compress(content.replace(b"drive", b"drove"), 9))
    result = CliRunner().invoke(main, ["emit", *options])
    assert f"benchmarks/full_range/spaceex/{path.name}" in json.loads(result.stdout)["differ"]
    path.write_bytes(content)
    assert CliRunner().invoke(main, ["emit", *options]).exit_code == 1
