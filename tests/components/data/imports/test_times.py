"""Formats of times are guessed from how they are written."""

import pytest

from components.data.imports.times import guess_format


@pytest.mark.parametrize(
    ("text", "form"),
    [
        ("01.03.2026 06:00:00", "%d.%m.%Y %H:%M:%S"),
        ("01.03.26 06:00", "%d.%m.%y %H:%M"),
        ("3/31/2026 6:00:00", "%m/%d/%Y %H:%M:%S"),
        ("31-03-2026T06:00:00.125", "%d-%m-%YT%H:%M:%S.%f"),
        ("31/03/2026", "%d/%m/%Y"),
        ("2026-03-31 06:00", None),
        ("noon", None),
        ("01.03.2026 ", None),
    ],
)
def test_guessed_formats(text: str, form: str | None) -> None:
    assert guess_format(text) == form
