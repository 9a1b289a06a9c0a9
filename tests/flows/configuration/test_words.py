"""Words of the command lines of doors that have few settings."""

import pytest

from flows.configuration.checking import SettingsError
from flows.configuration.words import fields_of_words


def test_values_are_taken_as_they_were_typed_whatever_their_name() -> None:
    words = ["run=a=b", "lambda=0..1", "--watch", "on=false"]
    fields = fields_of_words(
        words, on_off=["on"], switches=["watch"], other_names={"lambda": "proximity"}
    )
    assert fields == {"run": "a=b", "proximity": "0..1", "watch": "true", "on": "false"}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["lambda=0", "lambda=0"], "lambda is given twice; give it once."),
        (["lambda=0", "proximity=1"], "lambda is given twice; give it once."),
        (["proximity=0", "lambda=0..1"], "proximity is given twice; give it once."),
        (["on=true", "on=false"], "on is given twice; give it once."),
        (["--on"], "'--on': settings are written without dashes; write on=true."),
        (["on"], "'on' has no value; write on=true."),
        (["=1"], "'=1' is not an override; write key=value, e.g. store=mlruns."),
    ],
)
def test_refusals(words: list[str], says: str) -> None:
    with pytest.raises(SettingsError) as refused:
        fields_of_words(words, on_off=["on"], other_names={"lambda": "proximity"})
    assert str(refused.value) == says


@pytest.mark.parametrize("rest", ["bad-0.4]", "bad-0.4,", "[a,b]", "{a:1}"])
@pytest.mark.parametrize("switches", [(), ("watch",)])
def test_a_list_that_the_shell_has_split_is_seen_as_one(rest: str, switches: tuple) -> None:
    with pytest.raises(SettingsError, match=r"without spaces inside \[ \]"):
        fields_of_words(["datasets=[tank,", rest], switches=switches)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--watch", "watch=true"], "watch is given twice; give it once."),
        (["-w"], "'-w' is not a setting; write key=value, or --watch, or --json."),
        (["watch"], "'watch' is not a setting; write key=value, or --watch, or --json."),
        (
            ["--json=true"],
            "'--json=true' is not a setting; write key=value, or --watch, or --json.",
        ),
    ],
)
def test_refusals_of_a_door_with_switches(words: list[str], says: str) -> None:
    with pytest.raises(SettingsError) as refused:
        fields_of_words(words, switches=["watch", "json"])
    assert str(refused.value) == says
