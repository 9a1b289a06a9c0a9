"""How a search ended."""

from dataclasses import dataclass, field

__all__ = ["SearchOutcome"]


@dataclass
class SearchOutcome:
    """How a search ended.

    Attributes:
        failed: Names of studies of which no trial could be evaluated.
        interrupted: The exit code for the signal that ended the search; 0 for none.
        unrecorded: Why the tracker lacks trials; empty if it lacks none.
    """

    failed: list[str] = field(default_factory=list)
    interrupted: int = 0
    unrecorded: str = ""

    @property
    def status(self) -> str:
        """FINISHED, FAILED or KILLED."""
        return "KILLED" if self.interrupted else "FAILED" if self.failed else "FINISHED"

    @property
    def exit_code(self) -> int:
        """0 if all is found and recorded, 130 after Ctrl-C, 143 after SIGTERM, else 1."""
        return self.interrupted or int(bool(self.failed or self.unrecorded))
