"""Commands that look at the installation: doctor."""

from dataclasses import dataclass

from mi_ntf.commands.options import print_report


@dataclass
class Doctor:
    """Check Python, Mitsuba, LLVM, CUDA, the bridge and the extras, and name the remedy of each fault."""

    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> int:
        """Print the checks. The result is 1 if rendering is impossible."""
        from mi_ntf.doctor import examine, print_table

        report = examine()
        print_report(report, self.json, print_table)
        return 0 if report["ok"] else 1
