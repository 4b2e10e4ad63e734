"""Commands for the installation: bridge, doctor."""

from dataclasses import dataclass

from mi_ntf.commands import options
from mi_ntf.commands.options import Flag, Json
from mi_ntf.core import progress


@dataclass
class Doctor:
    """Check Python, Mitsuba, LLVM, CUDA, bridge and extras, and name remedies."""

    json: Json = False

    def run(self) -> int:
        """Print the checks. The result is 1 if rendering is impossible."""
        from mi_ntf.doctor import examine, print_table

        with progress.Stage("examining this machine"):
            report = examine()
        options.print_report(report, self.json, print_table)
        return 0 if report.ok else 1


@dataclass
class Bridge:
    """Compile the bridge, by which the program `mitsuba` finds the plugins."""

    remove: Flag = False
    """Delete the installed bridge instead."""

    def run(self) -> None:
        """Print the path of each file that was installed or removed."""
        from mi_ntf import build_bridge

        files = build_bridge.remove() if self.remove else build_bridge.build()
        for file in files:
            print(f"{'removed' if self.remove else 'installed'} {file}")
        if not self.remove:
            print("next: mitsuba SCENE.xml")
