"""Key files: created once, readable by their owner only, otherwise rejected with the remedy."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.cli import main
from handtouch.client import key_maker, keys
from handtouch.client.keys import KeyFileError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    key_maker.make_server_keys(tmp_path / "keys", "robot1")
    return tmp_path / "keys"


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_written_keys_are_loaded(folder: Path, tmp_path: Path) -> None:
    alice = key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
    bob = key_maker.add_client(folder, "bob", "control", tmp_path / "bob.key")
    server = keys.load_server(folder)
    assert keys.load_client(tmp_path / "alice.key") == alice
    assert alice.server == server.name == "robot1"
    assert alice.server_key == server.public_key
    clients, problems = keys.load_clients(folder)
    assert not problems
    assert {(c.name, c.rights, key) for key, c in clients.items()} == {
        ("alice", "read", alice.public_key),
        ("bob", "control", bob.public_key),
    }


def test_secret_files_are_private_and_the_others_world_readable(folder: Path, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
        key_maker.make_server_keys(tmp_path / "more", "robot2")
    finally:
        os.umask(before)
    assert _mode(folder / "server.key") == _mode(tmp_path / "alice.key") == 0o600
    assert _mode(tmp_path / "more/server.key") == 0o600
    assert _mode(folder / "clients/alice.pub") == 0o644
    assert _mode(tmp_path / "more") == _mode(tmp_path / "more/clients") == 0o755


def test_client_secrets_are_not_kept_by_the_daemon_and_not_in_repr(folder: Path, tmp_path: Path) -> None:
    alice = key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
    kept = "".join(path.read_text() for path in folder.rglob("*") if path.is_file())
    assert alice.secret_key not in kept
    assert alice.secret_key not in repr(alice)
    server = keys.load_server(folder)
    assert server.secret_key not in repr(server)


def test_no_key_is_overwritten(folder: Path, tmp_path: Path) -> None:
    key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    before = {path: path.read_bytes() for path in files}
    with pytest.raises(KeyFileError, match="exists already"):
        key_maker.make_server_keys(folder, "robot2")
    with pytest.raises(KeyFileError, match="exists already"):
        key_maker.add_client(folder, "alice", "control", tmp_path / "other.key")
    with pytest.raises(KeyFileError, match="exists already"):
        key_maker.add_client(folder, "carl", "control", tmp_path / "alice.key")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("file", "mode", "remedy"),
    [
        ("keys/server.key", 0o640, "chmod 600"),
        ("keys/server.key", 0o602, "chmod 600"),
        ("keys", 0o775, "chmod go-w"),
        ("keys/clients", 0o757, "chmod go-w"),
    ],
)
def test_daemon_keys_accessible_to_others_are_rejected(
    folder: Path, file: str, mode: int, remedy: str
) -> None:
    path = folder.parent / file
    path.chmod(mode)
    with pytest.raises(KeyFileError, match=f"{remedy} {path}"):
        keys.load_server(folder)


def test_a_client_key_readable_by_others_is_rejected(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "alice.key"
    key_maker.add_client(folder, "alice", "read", path)
    path.chmod(0o644)
    with pytest.raises(KeyFileError, match=f"chmod 600 {path}"):
        keys.load_client(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_key_owned_by_another_user_is_rejected(folder: Path) -> None:
    os.chown(folder / "server.key", 12345, 12345)
    with pytest.raises(KeyFileError, match="owned by user 12345"):
        keys.load_server(folder)


def _garble(path: Path) -> None:
    path.write_text(path.read_text() + "\x00")


def _no_right(path: Path) -> None:
    path.write_text(path.read_text().replace('"read"', '"all"'))


def _short(path: Path) -> None:
    path.write_text('rights = "read"\npublic_key = "x"\n')


@pytest.mark.parametrize(
    ("damage", "problem_text"),
    [
        (_garble, "not a key file"),
        (_no_right, "must be 'read' or 'control'"),
        (_short, "public_key is not a key"),
        (lambda path: path.write_text(""), "key 'rights' is missing"),
        (lambda path: path.chmod(0o646), "chmod go-w"),
    ],
)
def test_a_damaged_entry_authorises_no_client_and_leaves_others_valid(
    folder: Path, tmp_path: Path, damage: Callable[[Path], None], problem_text: str
) -> None:
    key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
    key_maker.add_client(folder, "bob", "read", tmp_path / "bob.key")
    damage(folder / "clients/alice.pub")
    clients, (problem,) = keys.load_clients(folder)
    assert [client.name for client in clients.values()] == ["bob"]
    assert str(folder / "clients/alice.pub") in problem
    assert problem_text in problem


def test_one_key_under_two_names_is_reported(folder: Path, tmp_path: Path) -> None:
    key_maker.add_client(folder, "alice", "read", tmp_path / "alice.key")
    text = (folder / "clients/alice.pub").read_text()
    (folder / "clients/zoe.pub").write_text(text.replace('"read"', '"control"'))
    clients, (problem,) = keys.load_clients(folder)
    assert [(client.name, client.rights) for client in clients.values()] == [("alice", "read")]
    assert "zoe.pub has the key of alice" in problem


def test_a_secret_key_that_does_not_match_the_public_key_is_rejected(folder: Path, tmp_path: Path) -> None:
    alice, bob = (key_maker.add_client(folder, name, "read", tmp_path / name) for name in ("alice", "bob"))
    path = tmp_path / "alice"
    path.write_text(path.read_text().replace(alice.secret_key, bob.secret_key))
    with pytest.raises(KeyFileError, match="are not a pair"):
        keys.load_client(path)


@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_are_rejected_naming_the_file(
    data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.key"
    path.touch(0o600)
    path.write_bytes(data)
    with pytest.raises(KeyFileError, match=r"any\.key"):
        keys.load_client(path)


def test_the_secret_may_come_from_a_service_manager(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = keys.load_server(folder)
    (tmp_path / "credentials").mkdir()
    credential = (folder / "server.key").rename(tmp_path / "credentials/server.key")
    credential.chmod(0o440)  # as systemd shows the access that it grants to one user by an ACL
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(credential.parent))
    assert keys.load_server(folder) == server


def test_the_commands_make_list_and_revoke(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["keys", "make", "keys", "--name", "robot1"]) == 0
    assert 'keys = "keys"' in capsys.readouterr().out
    assert main(["keys", "client", "keys", "alice"]) == 0
    assert main(["keys", "client", "keys", "bob", "--rights", "control", "--out", "b.key"]) == 0
    assert "HANDTOUCH_KEY=" in capsys.readouterr().out
    assert main(["keys", "list", "keys", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [(c["name"], c["rights"]) for c in listed["clients"]] == [("alice", "read"), ("bob", "control")]
    assert keys.load_client(Path("b.key")).name == "bob"
    assert main(["keys", "revoke", "keys", "alice"]) == 0
    assert main(["keys", "revoke", "keys", "alice"]) == 2
    assert "its clients: bob" in capsys.readouterr().err
    assert main(["keys", "list", "keys"]) == 0
    assert "alice" not in capsys.readouterr().out
    Path("keys/clients/bob.pub").chmod(0o666)
    assert main(["keys", "list", "keys"]) == 1
    assert "chmod go-w" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["", "../alice", "a/b", ".hidden", "a b", "x" * 65, "a\n"])
def test_a_name_cannot_lead_out_of_the_folder(folder: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(KeyFileError, match="a name consists of letters"):
        key_maker.add_client(folder, name, "read", tmp_path / "new.key")
    assert not (tmp_path / "new.key").exists()


@pytest.mark.parametrize(
    "command", [["client", "FOLDER", "alice"], ["list", "FOLDER"], ["revoke", "FOLDER", "alice"]]
)
def test_a_missing_key_folder_is_named_with_exit_status_2(
    tmp_path: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "absent")
    assert main(["keys", *(folder if argument == "FOLDER" else argument for argument in command)]) == 2
    assert folder in capsys.readouterr().err
