"""Words of a command line: ``key=value``, and the settings of doors that have few of their own.

Doors that run a sweep read theirs with :mod:`flows.configuration.overrides`, which needs Hydra and
takes a moment to be imported.
"""

from collections.abc import Callable, Collection, Mapping, Sequence

from flows.configuration.checking import SettingsError

__all__ = ["fields_of_words", "split_word"]


def split_word(
    word: str,
    is_on_off: Callable[[str], bool] = lambda key: False,
    example: str = "seeds=[0,1]",
) -> tuple[str, str]:
    """Key and value of a word of a command line.

    Args:
        word: ``key=value``.
        is_on_off: Tells of a key whether it is true or false.
        example: Shown where it is none.

    Raises:
        SettingsError: It is no such word; says how to write it.
    """
    key, equals, value = word.partition("=")
    if key.startswith("-"):
        name = key.lstrip("-").replace("-", "_")
        remedy = f"{name}={value or ('true' if is_on_off(name) else 'VALUE')}"
        raise SettingsError(f"{word!r}: settings are written without dashes; write {remedy}.")
    if key and not equals and is_on_off(key):
        raise SettingsError(f"{word!r} has no value; write {key}=true.")
    if (not equals and word[-1:] in (",", "]", "}")) or word[:1] in ("[", "{"):
        raise SettingsError(
            f"{word!r} seems to belong to the word before it: write lists without spaces inside "
            "[ ] and after =, or put quotation marks around the whole word."
        )
    if not equals or not key or key[0] in "+~":
        raise SettingsError(f"{word!r} is not an override; write key=value, e.g. {example}.")
    return key, value


def fields_of_words(
    words: Sequence[str],
    *,
    on_off: Collection[str] = (),
    switches: Collection[str] = (),
    other_names: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """The settings of a door that has few of its own, as they were typed.

    Args:
        words: Of its command line.
        on_off: Settings that are true or false.
        switches: Those of them that may be written ``--name``, too.
        other_names: Further names of settings, and the settings.

    Returns:
        Values by setting.

    Raises:
        SettingsError: A word is no key=value, or a setting is given twice, whatever its name.
    """
    fields: dict[str, str] = {}
    typed: dict[str, str] = {}
    for word in words:
        if word.startswith("--") and word[2:] in switches:
            word = f"{word[2:]}=true"
        elif switches and (word.startswith("-") or "=" not in word) and word not in on_off:
            if word[-1:] in (",", "]", "}"):
                split_word(word)  # says what is wrong with a list
            also = "".join(f", or --{name}" for name in switches)
            raise SettingsError(f"{word!r} is not a setting; write key=value{also}.")
        key, value = split_word(word, lambda name: name in on_off, example="store=mlruns")
        name = (other_names or {}).get(key, key)
        if name in fields:
            raise SettingsError(f"{typed[name]} is given twice; give it once.")
        fields[name], typed[name] = value, key
    return fields
