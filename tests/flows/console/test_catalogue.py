"""What is offered: ids are looked up, hostile and broken policies end in one sentence."""

from pathlib import Path

import pytest

from components.operating.session import Session
from flows.console.catalogue import Catalogue, NotOfferedError
from tests.flows.console.stores import (
    BROKEN,
    ESCAPING,
    HOSTILE,
    HTML,
    HUGE,
    ODD,
    OWN,
    TURBINE_LOG,
    hostile_store,
)


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    return Catalogue(hostile_store(tmp_path / "runs").root)


def test_shipped_policies_are_offered_first_and_without_a_store(tmp_path: Path) -> None:
    offers = Catalogue(tmp_path / "nowhere").offers()
    assert list(offers) == ["turbine", "world"]
    assert not (tmp_path / "nowhere").exists()
    assert Catalogue(tmp_path / "nowhere").open("world").policy.card.takes_proximity


def test_stored_policies_are_offered_by_their_keys(catalogue: Catalogue) -> None:
    offers = catalogue.offers()
    assert list(offers)[:2] == ["turbine", "world"]
    assert offers[OWN].title == "lion/own/seed0"
    assert TURBINE_LOG not in offers  # a log
    assert offers[HOSTILE].title == HTML  # text; that pages show it as text is tested there
    assert len(offers[ODD].title) == 80
    own = catalogue.open(OWN)
    assert own.log is not None
    assert Session(own).step().frames.shape == (2, 6)


def test_packed_folders_are_offered_beside_the_shipped_ones(
    tmp_path: Path, catalogue: Catalogue
) -> None:
    packed = tmp_path / "packed"
    for name in ("turbine", "furnace"):
        catalogue.open(OWN if name == "furnace" else "world").save(packed / name)
    (packed / "notes").mkdir()
    catalogue.open("world").save(tmp_path / "secret")
    beside = Catalogue(tmp_path / "runs", packed)
    assert list(beside.offers())[:4] == ["turbine", "world", "packed/furnace", "packed/turbine"]
    assert beside.offers()["packed/furnace"].title == "furnace (packed)"
    assert beside.open("turbine").card.name == "mediocre-0.2"  # its name is not taken from it
    assert beside.open("packed/turbine").card.name == "world"
    for asked in ("packed/../secret", "furnace", "packed/notes", "packed/", "packed/furnace/"):
        with pytest.raises(NotOfferedError):
            beside.open(asked)
    [alone] = [id for id in Catalogue(tmp_path / "runs", packed / "furnace").offers() if "/" in id]
    assert alone == "packed/furnace"
    (packed / "furnace" / "policy.json").write_text("{")
    with pytest.raises(ValueError, match=r"furnace \(packed\) cannot be used"):
        beside.open("packed/furnace")


@pytest.mark.parametrize(
    "asked",
    [
        "../../../../etc/passwd",
        "/etc/passwd",
        f"../nodes/{OWN}",
        f"{OWN}/policy",
        f"{OWN}\0",
        "..",
        "",
        "TURBINE",
        "turbine/../world",
        TURBINE_LOG,
        "%2e%2e%2f",
        "x" * 100_000,
    ],
)
def test_an_id_that_is_not_offered_is_refused(asked: str, catalogue: Catalogue) -> None:
    with pytest.raises(NotOfferedError, match=r"^There is no such policy\.$"):
        catalogue.open(asked)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (BROKEN, "is not JSON"),
        (HUGE, "no policy is so large"),
        (ESCAPING, "holds no finished run '../../../../../../etc'"),
        (ODD, "it is not the card"),
    ],
)
def test_a_broken_policy_is_refused_in_one_sentence(
    key: str, said: str, catalogue: Catalogue
) -> None:
    with pytest.raises(ValueError, match=said) as refused:
        catalogue.open(key)
    assert "\n" not in str(refused.value)
    assert catalogue.open(OWN)  # the others are as usable as before


def test_few_policies_are_kept_open(catalogue: Catalogue) -> None:
    first = catalogue.open("world")
    assert catalogue.open("world") is first
    for _ in range(2):
        for asked in ("world", "turbine", OWN, HOSTILE):
            catalogue.open(asked)
    assert len(catalogue._opened) <= 4
