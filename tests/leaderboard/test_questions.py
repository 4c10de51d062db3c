"""What the ID of an instance says where its files are not at hand."""

import pytest

from harness.records import Limits, Record, verdict_of
from leaderboard.questions import read_questions


@pytest.mark.parametrize(
    ("controller", "rays", "layers"),
    [
        ("TD3_L21_64x64_C1", 21, "64x64"),
        ("TD3_L121_64x64x64x64_C1", 121, "64x64x64x64"),
        ("TD3_L21_128x128relu_C12", 21, "128x128"),
        ("TD3_L1081_conv_C1", 1081, None),
    ],
)
def test_names_are_read_whatever_the_network(controller, rays, layers):
    record = Record(
        instance=f"{controller}.full_range.clearance",
        category="full_range",
        onnx="c.onnx",
        spec="i.json",
        onnx_sha256="0" * 64,
        spec_sha256="0" * 64,
        tool="alpha",
        tool_version=None,
        command=["tool"],
        started_at="2026-01-01T00:00:00Z",
        prepare_time=0.0,
        run_time=1.0,
        cpu_time=1.0,
        max_memory_mib=1.0,
        result="unknown",
        verdict=verdict_of("unknown"),
        limits=Limits(
            wall_s=20, wall_end_s=20.1, wall_kill_s=20.25, prepare_wall_s=600, kept_by="test"
        ),
        log="log",
    )
    (question,) = read_questions([record], None)
    assert (question.controller, question.rays, question.layers) == (controller, rays, layers)
    assert question.neurons == (sum(map(int, layers.split("x"))) if layers else None)
