"""What SAVE_CONFIG writes: read again it is what was meant, and the user's own text is untouched."""

import errno
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.config.file import SAVED_HEADER, parse_config, parse_saved, saved_values
from coordinator.config.saved import ConfigSource, PendingConfig, SaveError, replace_file, with_block
from coordinator.config.text import split_lines

USER = "# mine: ä\r\n[extruder]\r\ncontrol: pid   # by hand\r\n\r\n[bed_mesh default]\r\n"


def accept(path: str, data: bytes) -> None:
    """Load anything: what options mean does not matter here."""


def pending(path: Path) -> PendingConfig:
    config = parse_config(str(path))
    return PendingConfig(ConfigSource(config.path, config.data, saved_values(config), accept))


def saved(path: Path, text: str | bytes = USER, **options: str) -> bytes:
    """Save OPTIONS of [extruder] into a file of TEXT; return what it holds then."""
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    config = pending(path)
    for option, value in options.items():
        config.put("extruder", option, value)
    assert config.write() == str(path)
    return path.read_bytes()


def test_the_block_follows_the_users_text_in_its_own_line_ends(tmp_path: Path) -> None:
    data = saved(tmp_path / "printer.cfg", pid_kp="21.5", pid_ki="1.08")
    assert (
        data
        == (
            f"{USER}{SAVED_HEADER}\r\n"
            "#*# DO NOT EDIT THIS BLOCK OR BELOW. The machine writes it; its values override those above.\r\n"
            "#*#\r\n#*# [extruder]\r\n#*# pid_kp = 21.5\r\n#*# pid_ki = 1.08\r\n"
        ).encode()
    )


def test_a_second_save_replaces_the_block_and_keeps_what_it_had(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    first = saved(path, control="mpc", pid_kp="1")
    config = pending(path)
    config.put("extruder", "PID_KP", "2")
    config.put("bed_mesh  default", "points", "\n 0.1, 0.2\n\n  0.3, 0.4\n")
    assert config.pending == {
        "extruder": {"pid_kp": "2"},
        "bed_mesh default": {"points": "0.1, 0.2\n\n0.3, 0.4"},
    }
    config.write()
    assert config.pending == {}
    assert path.read_bytes().startswith(USER.encode())
    assert path.read_bytes().count(b"SAVE_CONFIG") == first.count(b"SAVE_CONFIG") == 1
    read = parse_config(str(path))
    assert saved_values(read) == {
        "extruder": {"control": "mpc", "pid_kp": "2"},
        "bed_mesh default": {"points": "0.1, 0.2\n\n0.3, 0.4"},
    }
    assert read.sections["extruder"].options["control"].value == "mpc"
    config.put("extruder", "pid_kp", "3")  # what was written counts as read
    config.write()
    assert parse_config(str(path)).saved["extruder"].options["pid_kp"].value == "3"


@pytest.mark.parametrize("text", ["", "[printer]\nkinematics: none", "\ufeff[printer]\n", "\ufeff", "a: b\r"])
def test_any_users_text_stays_as_it_is(tmp_path: Path, text: str) -> None:
    user = text if text != "a: b\r" else "[p]\ra: b\r"
    data = saved(tmp_path / "printer.cfg", user, pid_kp="1")
    assert data.startswith(user.encode())
    assert saved(tmp_path / "printer.cfg", data, pid_kp="1") == data


def test_mode_and_links_are_kept(tmp_path: Path) -> None:
    real = tmp_path / "real.cfg"
    real.write_text(USER)
    real.chmod(0o640)
    link = tmp_path / "printer.cfg"
    link.symlink_to("real.cfg")
    config = pending(link)
    config.put("extruder", "pid_kp", "1")
    config.write()
    assert link.is_symlink()
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    assert SAVED_HEADER in real.read_text()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["printer.cfg", "real.cfg"]


def test_a_file_that_changed_meanwhile_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(USER)
    config = pending(path)
    config.put("extruder", "pid_kp", "1")
    path.write_text("# mine now\n")
    with pytest.raises(SaveError, match=r"printer\.cfg' has changed since it was read, so nothing was saved"):
        config.write()
    assert path.read_text() == "# mine now\n"
    assert config.pending == {"extruder": {"pid_kp": "1"}}
    path.unlink()
    with pytest.raises(SaveError, match=r"cannot write .*printer\.cfg': No such file"):
        config.write()


@pytest.mark.parametrize(
    ("number", "way_out"),
    [
        (errno.ENOSPC, "free some space on its disk"),
        (errno.EDQUOT, "free some space: your quota"),
        (errno.EIO, "check its disk"),
        (errno.EROFS, "make the file and its folder writable"),
        (errno.EACCES, "make the file and its folder writable"),
    ],
)
def test_a_write_that_fails_leaves_the_old_file_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, way_out: str
) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(USER)
    before = path.read_bytes()

    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(SaveError, match=f"{os.strerror(number)}; {way_out}"):
        replace_file(str(path), before, b"new")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("section", "option", "text"),
    [
        ("extruder", "pid_kp", "1 # of many"),
        ("extruder", "pid_kp", "1\r2"),
        ("extruder", "pid_kp", "1\0"),
        ("extruder", "pid_kp", "\ud800"),
        ("extruder", "pid=kp", "1"),
        ("extruder]", "pid_kp", "1"),
        ("include other.cfg", "pid_kp", "1"),
        ("", "pid_kp", "1"),
        ("extruder", "", "1"),
        ("extruder", "do not edit", "1"),
    ],
)
def test_what_would_be_read_otherwise_is_refused_when_it_is_put(section: str, option: str, text: str) -> None:
    config = PendingConfig(ConfigSource("printer.cfg", b"", {}, accept))
    if option == "do not edit":  # a name in lower case is no notice
        config.put(section, option, text)
        return
    with pytest.raises(SaveError, match="cannot be saved as"):
        config.put(section, option, text)
    assert config.pending == {}


def test_a_machine_without_a_file_saves_nothing() -> None:
    with pytest.raises(SaveError, match="does not come from a file"):
        PendingConfig(None).write()


_WORD = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
_TEXT = st.text(st.characters(codec="utf-8"), max_size=30)


@given(
    user=st.lists(st.sampled_from(["# c", "[a]", "x: 1", "", "ü", SAVED_HEADER[:9]]), max_size=6).map(
        "\n".join
    ),
    values=st.dictionaries(
        _WORD, st.dictionaries(_WORD, _TEXT, min_size=1, max_size=3), min_size=1, max_size=3
    ),
)
def test_what_is_accepted_comes_back(user: str, values: dict[str, dict[str, str]]) -> None:
    config = PendingConfig(ConfigSource("", b"", {}, accept))
    for section, options in values.items():
        for option, text in options.items():
            try:
                config.put(section, option, text)
            except SaveError:
                continue
    data = with_block(user.encode(), config.pending)
    assert data.startswith(user.encode())
    assert with_block(data, config.pending) == data

    lines = split_lines(data, "")
    assert parse_saved("", lines[lines.index(SAVED_HEADER) :]) == config.pending


FOREIGN = """\
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [bed_mesh default]
#*# version = 1
#*# points =
#*# \t  0.025000, -0.010000
#*# \t  0.015000, 0.020000
#*# x_count=2
#*#
#*# [extruder]
#*# control = pid
#*#
#*# [probe]
#*# z_offset = 1.250
"""


def test_sections_of_others_in_the_block_stay_byte_for_byte(tmp_path: Path) -> None:
    after = saved(tmp_path / "printer.cfg", USER + FOREIGN, control="mpc").decode()
    for section, end in (("[bed_mesh default]", "#*#\n#*# [extruder]"), ("[probe]", "")):
        text = (
            FOREIGN[FOREIGN.index(f"#*# {section}") :].partition(end)[0]
            if end
            else "#*# [probe]\n#*# z_offset"
        )
        assert text.replace("\n", "\r\n") in after, section
    assert "#*# control = mpc\r\n" in after
    assert "control = pid" not in after.partition("#*#")[2]
