"""Settings that came later leave the identity of earlier results as it was."""

from dataclasses import asdict, dataclass

from components.core.options import identity, option, with_options


@dataclass(frozen=True)
class Settings:
    size: int = 3
    limit: float | None = None
    scale: float | None = option(None)
    kind: str = option("plain")


def test_options_count_only_where_they_are_taken() -> None:
    assert identity(Settings()) == {"size": 3, "limit": None}
    assert identity(Settings(scale=2.0)) == {"size": 3, "limit": None, "scale": 2.0}
    assert identity(Settings(size=4, kind="odd")) == {"size": 4, "limit": None, "kind": "odd"}


def test_what_is_left_out_comes_back_as_its_default() -> None:
    for settings in (Settings(), Settings(kind="odd"), Settings(limit=1.0)):
        assert Settings(**identity(settings)) == settings
        assert with_options(Settings, identity(settings)) == asdict(settings)
