"""Result files are read as VNN-COMP reads them, whatever a tool left there."""

import os

import pytest

from harness.answer import LARGEST_WITNESS, parse_answer, read_answer, witness_in
from harness.records import Verdict, verdict_of


@pytest.mark.parametrize(
    ("content", "result"),
    [
        (b"unsat\n", "unsat"),
        (b"unsat", "unsat"),
        (b"  UNSAT \r\nrest", "unsat"),
        (b"un sat\n", "unsat"),  # VNN-COMP deletes white space
        (b"unknown\n", "unknown"),
        (b"timeout\n", "timeout"),
        (b"timeout(X_00 ...\n", "timeout"),
        (b"timed-out\n", "timeout"),
        (b"error\n", "error"),
        (b"holds\n", "unsat"),
        (b"", "no_result_in_file"),
        (b"\nunsat\n", "no_result_in_file"),
        (b"unsatisfied\n", "error"),
        (b"sat?\n", "error"),
        (b"\xff\xfe\x00s\x00a\x00t\n", "error"),
        (b"x" * 10_000_000, "error"),
    ],
)
def test_first_line_is_the_answer(content, result):
    answer = parse_answer(content)
    assert answer.result == result
    assert answer.witness is None


@pytest.mark.parametrize("first", [b"sat", b"SAT\r", b"violated"])
def test_witness_follows_sat(first):
    answer = parse_answer(first + b"\n{\n}\n")
    assert answer.result == "sat"
    assert answer.witness == b"{\n}\n"


def test_garbage_is_quoted():
    assert "'I am sure'" in parse_answer(b"I am sure\n").detail


def test_missing_file(tmp_path):
    assert read_answer(tmp_path / "none").result == "no_result_in_file"


def test_link_is_not_followed(tmp_path):
    (tmp_path / "target").write_text("unsat\n")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    assert read_answer(tmp_path / "link").result == "no_result_in_file"


def test_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    answer = read_answer(tmp_path / "pipe")
    assert answer.result == "no_result_in_file"
    assert "plain file" in answer.detail


def test_huge_file_is_not_read_whole(tmp_path):
    path = tmp_path / "huge"
    with path.open("wb") as file:
        file.write(b"sat\n")
        file.truncate(3 << 30)  # sparse
    answer = read_answer(path)
    assert answer.result == "sat"
    assert LARGEST_WITNESS < len(answer.witness) < LARGEST_WITNESS + 2000


@pytest.mark.parametrize(
    ("content", "witness"),
    [
        (b'{"s": 1}', b'{"s": 1}'),
        (b'\n{"s": 1}', b'\n{"s": 1}'),
        (b'sat\n{"s": 1}', b'{"s": 1}'),
        (b"sat\n", b""),
        (b"unsat\n", b""),
        (b"", b""),
        (b"garbage", b"garbage"),
    ],
)
def test_witness_files_and_result_files(content, witness):
    assert witness_in(content) == witness


@pytest.mark.parametrize(
    ("result", "verdict"),
    [
        ("sat", Verdict.SAT),
        ("run_instance_timeout", Verdict.TIMEOUT),
        ("prepare_instance_timeout", Verdict.TIMEOUT),
        ("prepare_instance_error_3", Verdict.UNKNOWN),
        ("error_exit_code_139", Verdict.ERROR),
        ("no_result_in_file", Verdict.UNKNOWN),
    ],
)
def test_result_codes_count_as_in_vnncomp(result, verdict):
    assert verdict_of(result) is verdict


@pytest.mark.parametrize("text", ["", "satt", "error_exit_code_", "error_exit_code_-1", "holds"])
def test_other_text_is_no_result_code(text):
    with pytest.raises(ValueError, match="result code"):
        verdict_of(text)
