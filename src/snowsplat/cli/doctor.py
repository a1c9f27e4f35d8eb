"""`snowsplat doctor`: the machine and the installation, and what is missing."""

from dataclasses import dataclass
from typing import Any

from snowsplat.cli.command import Exit, JsonCommand, print_message
from snowsplat.util.safe_json import printable


@dataclass(frozen=True, kw_only=True)
class Doctor(JsonCommand):
    """Show what snowsplat uses of this computer, and what is missing.

    Examples:
      snowsplat doctor
      snowsplat doctor --json > doctor.json    for a bug report

    Notes:
      One line each for the versions, the processor, memory, disk, GPU and packages.
      MISSING and BROKEN are followed by what does not work without them. The exit
      code is 1 if something is missing without which nothing works, otherwise 0.
    """

    def run(self) -> Exit:
        """Returns the exit code: 0, or 1 if something essential is missing."""
        from snowsplat.pipeline.doctor import examine

        findings = []
        for finding in examine():
            findings.append(finding)
            if not self.json:  # at once: importing the packages takes a few seconds
                print(printable(f"{finding.name:22}  {finding.text}"), flush=True)
        problems = [finding for finding in findings if finding.problem]
        names = ", ".join(finding.name for finding in problems)
        if not self.json:
            if problems:
                print_message("\nsee above: {names}", names=names)
            else:
                print_message("\nnothing is missing; to try it: snowsplat demo")
        facts: dict[str, Any] = {finding.name: finding.values for finding in findings}
        facts["problems"] = [f"{finding.name}: {finding.text}" for finding in problems]
        return Exit(int(any(finding.essential for finding in problems)), facts)
