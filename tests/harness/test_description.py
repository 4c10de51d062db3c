"""tool.toml: what is taken, what is refused and in which words, the published schema."""

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from harness.description import description_schema, fill, load_description
from harness.tool import SHIPPED, find_tool, shipped_tools
from racecar.errors import BadInput

DOCS = Path(__file__).parents[2] / "docs"
SMALL = """
format = "closedlap-tool-1.0"
name = "small"
summary = "small"
[accepts]
formats = ["json"]
[run]
command = ["prove", "{spec}"]
[result]
form = "rules"
[[result.rules]]
verdict = "unsat"
all = ['^safe$']
"""


def load(tmp_path, text):
    (tmp_path / "tool.toml").write_text(text)
    return load_description(tmp_path / "tool.toml")


def test_a_small_description_has_sensible_defaults(tmp_path):
    tool = load(tmp_path, SMALL)
    assert tool.run.status == (0,)
    assert tool.status == "untested"
    assert tool.result.otherwise == "unknown"
    assert find_tool(str(tmp_path)).name == "small"
    assert find_tool(str(tmp_path), "other").name == "other"


@pytest.mark.parametrize(("old", "new", "complaint"), [
    ("{spec}", "{spek}", "run: {spek} is unknown; choose from {category}, {folder}"),
    ('"prove"', '"{bin}/prove"', "run: {bin} is unknown"),  # nothing is installed
    ("'^safe$'", "'(safe'", "result.rules.0.all.0: '(safe' is not a regular expression"),
    ('form = "rules"', 'form = "vnncomp"', "result: form 'rules' needs rules"),
    ('verdict = "unsat"', 'verdict = "sat"', "witness: a tool that answers sat must give"),
    ('verdict = "unsat"', 'verdict = "maybe"', "result.rules.0.verdict: Input should be 'sat'"),
    ('name = "small"', 'name = "../small"', "name: String should match"),
    ('summary = "small"', "", "summary: Field required"),
    ('summary = "small"', 'sumary = "s"\nsummary = "s"', "sumary: there is no such key"),
    ('["prove", "{spec}"]', "[]", "run.command: Tuple should have at least 1 item"),
    ('["json"]', '["dot"]', "accepts.formats.0: Input should be 'json'"),
    ("[run]", "[run", "not TOML: "),
    ("-1.0", "-9.0", "format: Input should be 'closedlap-tool-1.0'"),
])  # fmt: skip
def test_what_is_wrong_is_said_in_one_line_with_its_place(tmp_path, old, new, complaint):
    assert old in SMALL
    with pytest.raises(BadInput) as error:
        load(tmp_path, SMALL.replace(old, new, 1))
    message = str(error.value)
    assert message.startswith(f"{tmp_path / 'tool.toml'}: ")
    assert complaint in message
    assert "\n" not in message


@pytest.mark.parametrize(("more", "complaint"), [
    ("[witness]\nform = 'text'", "witness: no rule of result says sat"),
    ("[version]", "version: give either text or command"),
    ("[programs.spec]\nvariable = 'X'\nhelp = 'y'", "programs.spec: the name is taken"),
    ("[[prepare]]\ncommand = ['cat', '{results}']", "prepare.0: {results} is unknown"),
])  # fmt: skip
def test_parts_must_go_together(tmp_path, more, complaint):
    with pytest.raises(BadInput) as error:
        load(tmp_path, f"{SMALL}{more}\n")
    assert complaint in str(error.value)


def test_values_need_groups(tmp_path):
    sat = SMALL.replace('"unsat"', '"sat"')
    with pytest.raises(BadInput, match=r"must have the groups \(\?P<index>"):
        load(tmp_path, sat + "[witness]\nform = 'values'\ninputs = 'x = (.*)'\n")
    tool = load(
        tmp_path,
        sat
        + r"""[witness]
form = 'values'
inputs = 'x(?P<index>\d) = (?P<value>.*)'
""",
    )
    assert tool.witness.form == "values"


def test_placeholders_are_replaced_and_nothing_else():
    assert fill("a{onnx}b{spec}", {"onnx": "{spec}", "spec": "s"}) == "a{spec}bs"


def test_a_folder_with_both_kinds_is_refused(tmp_path):
    (tmp_path / "tool.toml").write_text(SMALL)
    (tmp_path / "run_instance.sh").write_text("")
    with pytest.raises(BadInput, match=r"both tool\.toml and scripts"):
        find_tool(str(tmp_path))


def test_published_schema_is_current_and_takes_what_ships():
    published = json.loads((DOCS / "tool.schema.json").read_text())
    assert published == description_schema()
    jsonschema.Draft202012Validator.check_schema(published)
    for path in SHIPPED.glob("*/tool.toml"):
        jsonschema.validate(tomllib.loads(path.read_text()), published)


def test_the_example_in_the_docs_is_one(tmp_path):
    text = (DOCS / "tool-interface.md").read_text()
    example = text.partition("```toml\n")[2].partition("```")[0]
    tool = load(tmp_path, example)
    assert (tool.name, tool.run.reserve, tool.witness.check) == ("prover", 2, True)


def test_every_shipped_tool_says_what_it_is():
    for name in shipped_tools():
        tool = find_tool(name)
        assert tool.name == name
        assert tool.about is not None, name
        assert tool.about.summary
        assert (SHIPPED / name) == Path(tool.folder)
        # What nobody here can run says so; its version is the user's affair.
        assert (tool.about.status == "tested") == (tool.version is not None)
