"""The record by which the door uses a study."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from flows.configuration.checking import SettingsError
from flows.configuration.settings import Settings
from flows.configuration.words import split_word
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan

__all__ = ["Drawn", "Study"]


@dataclass(frozen=True)
class Drawn:
    """What a study has found.

    Attributes:
        files: Figures and tables that it wrote.
        text: Its table beside the thesis's numbers, as Markdown.
    """

    files: Sequence[Path]
    text: str


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study.

    Attributes:
        name: On the command line.
        about: A sentence for the help.
        subject: Words of a command line that make it this study; they cannot be given otherwise.
        defaults: Further words, each of which the command line may replace.
        quick: Words that make it affordable; all of them give way to a profile that is given.
        takes: How long it takes on two idle cores, for the help.
        plan: The nodes that it needs; by default those of the benchmark.
        draw: ``draw(plan, store, folder)`` writes figures and tables of a finished plan into an
            existing folder.
    """

    name: str
    about: str
    subject: tuple[str, ...]
    defaults: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    takes: str = "minutes"
    plan: Callable[[Settings], Plan] = benchmark_plan
    draw: Callable[[Plan, ArtifactStore, Path], Drawn]

    def words(self, given: Sequence[str]) -> list[str]:
        """The words of the whole command line.

        Args:
            given: Those after the study's name.

        Raises:
            SettingsError: One of them changes the subject.
        """
        keys = {split_word(word)[0] for word in given if "=" in word}
        for word in self.subject:
            if word.partition("=")[0] in keys and word not in given:
                raise SettingsError(
                    f"The study {self.name} is about {' '.join(self.subject)}; leave these out, or "
                    "use flows.full_benchmark for others."
                )
        proposed = self.defaults if "profile" in keys else (*self.defaults, *self.quick)
        own = (word for word in proposed if word.partition("=")[0] not in keys)
        return [*self.subject, *own, *(word for word in given if word not in self.subject)]
