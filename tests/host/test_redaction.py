"""Texts for a bug report contain no secret."""

from __future__ import annotations

import json

import pytest

from handtouch.cli.support import redact

PLANTED = "hunter2-Zx9"


@pytest.mark.parametrize(
    "text",
    [
        f"api_token = {PLANTED}",
        f'password = "{PLANTED}"',
        f'password = "with \\" quote {PLANTED}"',
        f'passphrase = """\nover\n{PLANTED}\nlines"""',
        f"secret='{PLANTED}'",
        f'secret="{PLANTED}',
        f'Environment="FLEET_TOKEN={PLANTED}"',
        f"HANDTOUCH_RUN_OPTIONS=--upload-token {PLANTED}",
        f"uploading to mqtt://robot:{PLANTED}@fleet.example/hand",
        f"Authorization: Basic {PLANTED}",
        f"header was 'Bearer {PLANTED}'",
        f"# token: {PLANTED} (old one)",
        json.dumps({"client_secret": PLANTED}),
        f"-----BEGIN PRIVATE KEY-----\n{PLANTED}\n-----END PRIVATE KEY-----",
        f"-----BEGIN EC PRIVATE KEY-----\n{PLANTED}",
        f'public_key = "{PLANTED:x<40}"',
    ],
)
def test_a_secret_is_removed(text: str) -> None:
    redacted, count = redact(text)
    assert PLANTED not in redacted
    assert count == 1


def test_a_known_secret_is_removed_wherever_it_is() -> None:
    assert redact(f"a{PLANTED}b {PLANTED}", [PLANTED, ""]) == ("a<removed>b <removed>", 2)


@pytest.mark.parametrize(
    "text",
    [
        "2026-01-01 client rejected: no_key 3, unknown_key 1",
        'keys = "keys"',
        'live = "tcp://*:5580"',
        "the token bucket of requests is empty",
        '{"status": "ok", "endpoint": "tcp://127.0.0.1:5581"}',
    ],
)
def test_ordinary_text_stays(text: str) -> None:
    assert redact(text) == (text, 0)


def test_json_stays_json() -> None:
    values = {"token": "abc", "rate_hz": 200, "nested": {"password": "x y", "bus": "can0"}}
    redacted, count = redact(json.dumps(values, indent=2))
    parsed = json.loads(redacted)
    assert (parsed["rate_hz"], parsed["nested"]["bus"], count) == (200, "can0", 2)
