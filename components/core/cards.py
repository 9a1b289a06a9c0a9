"""Cards: frozen dataclasses, stored as JSON files, that describe the artifact beside them.

A card that cannot be used ends in one sentence that names the file and the remedy.
"""

import json
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

from components.core.integrity import DamagedFileError, MissingFileError

__all__ = ["CardFormat"]

C = TypeVar("C")


@dataclass(frozen=True, kw_only=True)
class CardFormat(Generic[C]):
    """How cards of one kind are stored.

    The file holds every field of the dataclass that has no plain default, and no unknown field. An
    error that the dataclass raises is reported like an error of the file.

    Attributes:
        kind: The dataclass. Its fields of tuples are lists in the file.
        what: What a card is about, for messages, e.g. "policy".
        remedy: What to do about a card that cannot be used, e.g. "train the policy again".
        version: Key and value that cards of this format have; None where there are no versions.
        amend: Adapts a file's values in place: renames stored names to those of the fields and
            fills in what older files lack.
    """

    kind: Callable[..., C]
    what: str
    remedy: str
    version: tuple[str, object] | None = None
    amend: Callable[[dict[str, Any]], None] = lambda values: None

    def read(self, path: Path) -> C:
        """Read a card.

        Raises:
            MissingFileError: There is none.
            DamagedFileError: It is damaged, of another version, or has other fields than the
                dataclass.
        """
        if not path.is_file():
            raise MissingFileError(
                f"There is no {self.what} in {path.parent}: {path.name} is missing",
                path,
                self.remedy,
            )
        try:
            return self.parse(path.read_bytes(), path)
        except ValueError as error:
            raise DamagedFileError(str(error), path) from error

    def parse(self, text: str | bytes, source: object) -> C:
        """Read a card from its text.

        Args:
            text: JSON.
            source: Where the text was, for messages.

        Raises:
            ValueError: The text is damaged, of another version, or has other fields than the
                dataclass.
        """
        try:
            return self._card(text)
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{source} cannot be used because {_reason(error)}; {self.remedy}."
            ) from error

    def _card(self, text: str | bytes) -> C:
        values: Any = json.loads(text)
        if not isinstance(values, dict):
            raise TypeError("it is no JSON object")
        if self.version is not None:
            key, expected = self.version
            found = values.pop(key, None)
            if found != expected:
                name = key.replace("_", " ")
                raise ValueError(f"its {name} is {found!r} and this version reads {expected!r}")
        self.amend(values)
        kinds = typing.get_type_hints(self.kind)
        known = fields(typing.cast(Any, self.kind))
        needed = {field.name for field in known if field.default is MISSING}
        wrong = (needed - values.keys()) | (values.keys() - {field.name for field in known})
        if wrong:
            raise ValueError(f"it has missing or unknown fields ({', '.join(sorted(wrong))})")
        for name, value in values.items():
            if typing.get_origin(kinds[name]) is tuple:
                values[name] = tuple(value)
        return self.kind(**values)


def _reason(error: Exception) -> str:
    if isinstance(error, (json.JSONDecodeError, UnicodeDecodeError)):
        return f"it is not JSON ({error})"
    return str(error).rstrip(".")
