"""`splatpilot doctor`."""

import argparse
from typing import Any

from splatpilot.analysis.commands import options as cli


@cli.command(
    "doctor",
    cli.json_option("the findings"),
    examples=("doctor", "doctor --json"),
)
def doctor(options: argparse.Namespace) -> Any:
    """Checks processor, GPU, EGL, the route of LCM messages, the video encoder, the packages of
    each extra, data and scenes. Each missing part has one remedy."""
    from splatpilot.analysis.doctor import examine, format_findings

    findings = examine()
    print(format_findings(findings))
    return findings
