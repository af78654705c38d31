"""`splatpilot doctor`."""

import argparse
from typing import Any

from splatpilot.analysis.commands.options import add_json, add_verb


def add_to(verbs: argparse._SubParsersAction) -> None:
    doctor = add_verb(
        verbs,
        "doctor",
        _doctor,
        help="say what this machine can do, and what to install or set for the rest",
        description="Looks at processor, GPU, EGL, the route for LCM's messages, the video "
        "encoder, the packages of each extra, data and scenes. What lacks has one remedy.",
        examples=("doctor", "doctor --json"),
    )
    add_json(doctor, "what was found")


def _doctor(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.doctor import examine, format_findings

    findings = examine()
    print(format_findings(findings))
    return findings
