"""Run the commands as ``python -m racecar``."""

from racecar.cli import main

main(prog_name="racecar")
