"""Takes secrets out of every text that leaves for people: messages, tags, tracebacks.

MLflow, requests and SQLAlchemy quote addresses in their errors, whole or in pieces, and
MLFLOW_TRACKING_URI may hold a password or a token.
"""

import os
import re
from base64 import b64encode
from collections.abc import Iterator
from urllib.parse import parse_qsl, quote, quote_plus, unquote

__all__ = ["without_secrets"]

_HIDDEN = "***"
_VARIABLES = (
    "AWS_SECRET_ACCESS_KEY",
    "AWS_SESSION_TOKEN",
    "AZURE_STORAGE_ACCOUNT_KEY",
    "AZURE_STORAGE_CONNECTION_STRING",
    "AZURE_STORAGE_SAS_TOKEN",
    "DATABRICKS_TOKEN",
    "FSSPEC_S3_SECRET",
    "FSSPEC_S3_TOKEN",
    "MLFLOW_TRACKING_PASSWORD",
    "MLFLOW_TRACKING_TOKEN",
    "RAY_AUTH_TOKEN",
)
_SECRET_NAME = re.compile("token|key|secret|pass|pwd|auth|sig|cred", re.IGNORECASE)
_SHORTEST = 4  # letters of a secret that is hidden also outside of addresses
_LONG = 12  # letters from which on any value of a query may be a secret

# A password may hold `@` and `/`: everything up to the last `@` goes.
_USER = re.compile(r"://[^\s'\"<>]*@")
_QUERY = re.compile(r"([?&][\w.%\-\[\]]+=)[^\s&'\"<>)]+")


def without_secrets(text: str) -> str:
    """A text without passwords, tokens, and the user parts and query values of addresses.

    Args:
        text: Any text, of one line or many.
    """
    text = _QUERY.sub(rf"\1{_HIDDEN}", _USER.sub("://", text))
    for secret in sorted(set(_forms()), key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text


def _forms() -> Iterator[str]:
    """The secrets of this process's environment, in the forms in which a text may hold them."""
    for secret in _known():
        for form in (secret, unquote(secret), quote(secret, safe=""), quote_plus(secret)):
            if len(form) >= _SHORTEST:
                yield form


def _known() -> Iterator[str]:
    yield from (os.environ.get(name, "") for name in _VARIABLES)
    rest = os.environ.get("MLFLOW_TRACKING_URI", "").partition("://")[2]
    user_part, there, _ = rest.rpartition("@")
    if there:
        user, separator, password = user_part.partition(":")
        secret = password if separator else user  # a token may stand for the user
        yield secret
        yield b64encode(unquote(user_part).encode()).decode()
        # An error may quote what stands between two signs that end a part of an address.
        yield from re.split(r"[/@?#:]", secret)
    for name, value in parse_qsl(rest.partition("?")[2]):
        if _SECRET_NAME.search(name) or len(value) >= _LONG:
            yield value
