"""Runs the command line, `python -m splatpilot`."""

import sys

from splatpilot.analysis.commands.main import run

sys.exit(run())
