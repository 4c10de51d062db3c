"""The command ``harness``: run tools on instances, replay witnesses, score runs.

Every command imports what it needs, so that none waits for what another needs.
"""

from __future__ import annotations

import click

from harness.export_command import export_command
from harness.log_command import log_command
from harness.replay_command import replay_command
from harness.run_command import run_command
from harness.score_command import score_command
from harness.submit_command import submit_command, verify_command
from harness.tools_command import check_tool_command, new_tool_command, tools_command
from racecar.command_line import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Run verifiers on instances and judge what they answer."""


for command in (
    check_tool_command,
    export_command,
    log_command,
    new_tool_command,
    replay_command,
    run_command,
    score_command,
    submit_command,
    tools_command,
    verify_command,
):
    main.add_command(command)
