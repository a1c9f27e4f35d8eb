"""`snowsplat doctor`: the machine and the installation, and what is missing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any

from snowsplat.cli.flags import switch
from snowsplat.util.safe_json import printable


@dataclass
class Doctor:
    """Show what snowsplat uses of this computer, and what is missing.

    Examples:
      snowsplat doctor
      snowsplat doctor --json > doctor.json    for a bug report

    Notes:
      One line each for the versions, the processor, memory, disk, GPU and packages.
      MISSING and BROKEN are followed by what does not work without them. The exit
      code is 1 if something is missing without which nothing works, otherwise 0.
    """

    json: Annotated[bool, switch()] = False
    """Print JSON, which other programs can read."""

    def run(self) -> int:
        """Returns the exit code: 0, or 1 if something essential is missing."""
        from snowsplat.pipeline.doctor import examine

        findings = []
        for finding in examine():
            findings.append(finding)
            if not self.json:  # at once: importing the packages takes a few seconds
                print(printable(f"{finding.name:22}  {finding.text}"), flush=True)
        problems = [finding for finding in findings if finding.problem]
        if self.json:
            facts: dict[str, Any] = {finding.name: finding.values for finding in findings}
            facts["problems"] = [f"{finding.name}: {finding.text}" for finding in problems]
            print(json.dumps(facts, indent=2))
        else:
            names = ", ".join(finding.name for finding in problems)
            print(
                f"\nsee above: {names}"
                if problems
                else "\nnothing is missing; to try it: snowsplat demo"
            )
        return int(any(finding.essential for finding in problems))
