"""Commands for the installation: bridge, doctor."""

from dataclasses import dataclass

from mi_ntf.commands.options import print_report


@dataclass
class Bridge:
    """Build the bridge, by which the program `mitsuba` finds the plugins nrf and ntf. It needs a C++ compiler."""

    remove: bool = False
    """Delete the bridge in place of building it."""

    def run(self) -> None:
        """Build or delete the bridge and print the paths of its files."""
        from mi_ntf import build_bridge

        for path in build_bridge.remove() if self.remove else build_bridge.build():
            print(f"{'removed' if self.remove else 'installed'} {path}")


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
