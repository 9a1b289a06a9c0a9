"""No secret of an address or of the environment leaves in a text."""

import pytest

from flows.pipeline.tracking.redaction import without_secrets


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("http://name:secret@host:5000/x", "http://host:5000/x"),
        ("http://token-as-user@host", "http://host"),
        (
            "postgresql+psycopg2://u:p@ss@w/rd@db/runs failed",
            "postgresql+psycopg2://db/runs failed",
        ),
        ("url: /api/2.0/x?token=abc&y=d (Caused by", "url: /api/2.0/x?token=***&y=*** (Caused by"),
        ("'http://a:b@c' and http://d:e@f", "'http://c' and http://f"),
        ("mail me@home, not a://b", "mail me@home, not a://b"),
        ("sqlite:////x/mlflow.db", "sqlite:////x/mlflow.db"),
    ],
)
def test_addresses_lose_user_part_and_values(
    monkeypatch: pytest.MonkeyPatch, text: str, left: str
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert without_secrets(text) == left


@pytest.mark.parametrize(
    "said",
    [
        "password authentication failed: p@ss/word",
        "invalid literal for int() with base 10: 'word'",
        "bad password p%40ss/word",
        "Authorization: Basic bmFtZTpwQHNzL3dvcmQ=",
        "header was Bearer t0ken-of-env",
        "refused the value from-the-query",
    ],
)
def test_secrets_are_hidden_outside_of_addresses(
    monkeypatch: pytest.MonkeyPatch, said: str
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://name:p@ss/word@host?token=from-the-query&n=1")
    monkeypatch.setenv("MLFLOW_TRACKING_TOKEN", "t0ken-of-env")
    left = without_secrets(said)
    for secret in ("ss/word", "word'", "bmFtZTpw", "t0ken", "from-the-query"):
        assert secret not in left
    assert "***" in left
    assert without_secrets("the name of host 1") == "the name of host 1"
