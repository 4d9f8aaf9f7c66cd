from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.config import text as config_text
from coordinator.config.errors import ConfigError, Place
from coordinator.config.file import ConfigFile, parse_config
from tests.profiles import examples
from tests.stages.printer_text import write


def values(config: ConfigFile) -> dict[str, dict[str, str]]:
    return {
        name: {option.name: option.value for option in section.options.values()}
        for name, section in config.sections.items()
    }


def parse(tmp_path: Path, text: str | bytes) -> ConfigFile:
    return parse_config(write(tmp_path, text))


def refused(tmp_path: Path, text: str | bytes) -> str:
    """Return the sentence without the folder of the test."""
    with pytest.raises(ConfigError) as error:
        parse(tmp_path, text)
    return str(error.value).replace(f"{tmp_path}/", "")


def test_sections_options_and_comments(tmp_path: Path) -> None:
    text = (
        "# head\n[ mcu   toolhead ] # why\nSerial: /dev/x  # which\nbaud = 115200 ; speed\n"
        "; all of it\n[fan]\npin:PA1#right behind\nname: a = b: c\nempty:\n"
        "template: {# not this #}{a}#this\nturn: a;b\n"
    )
    assert values(parse(tmp_path, text)) == {
        "mcu toolhead": {"serial": "/dev/x", "baud": "115200"},
        "fan": {
            "pin": "PA1",
            "name": "a = b: c",
            "empty": "",
            "template": "{# not this #}{a}",
            "turn": "a;b",
        },
    }


def test_every_option_knows_its_line(tmp_path: Path) -> None:
    config = parse(tmp_path, "\n[a b]\nx: 1\n\n  # no\ny: 2\n")
    section = config.sections["a b"]
    assert (section.kind, section.instance, section.place.line) == ("a", "b", 2)
    assert {option.name: option.place.line for option in section.options.values()} == {"x": 3, "y": 6}
    assert str(section.options["y"].place) == f"{tmp_path}/printer.cfg:6"


def test_values_go_on_over_indented_lines(tmp_path: Path) -> None:
    text = (
        "[gcode_macro M]\ngcode:\n  G28 ; home\n# gone\n\n    G1 X1\n  # gone too\n"
        "  x: not an option\n\nnext: 1\n"
    )
    assert values(parse(tmp_path, text)) == {
        "gcode_macro M": {"gcode": "G28\n\nG1 X1\nx: not an option", "next": "1"},
    }


def test_indented_options_are_options(tmp_path: Path) -> None:
    assert values(parse(tmp_path, "[a]\n  x: 1\n  y: 2\n     more\n")) == {"a": {"x": "1", "y": "2\nmore"}}


def test_line_ends_and_byte_order_mark(tmp_path: Path) -> None:
    assert values(parse(tmp_path, b"\xef\xbb\xbf[a]\r\nx: 1\r\ny: 2")) == {"a": {"x": "1", "y": "2"}}


def test_a_later_section_of_the_same_name_overrides(tmp_path: Path) -> None:
    config = parse(tmp_path, "[a]\nx: 1\ny: 2\n[b]\n[a]\ny: 3\n")
    assert values(config) == {"a": {"x": "1", "y": "3"}, "b": {}}
    assert config.sections["a"].place.line == 1
    assert config.sections["a"].options["y"].place.line == 6


def test_of_an_option_given_again_the_last_holds_and_one_notice_says_so(tmp_path: Path) -> None:
    config = parse(tmp_path, "[a]\nx: 1\nX = 2\nx: 3\n[b]\nx: 1\n")
    assert values(config) == {"a": {"x": "3"}, "b": {"x": "1"}}
    assert [note.replace(f"{tmp_path}/", "") for note in config.notes] == [
        "printer.cfg:4: option 'x' of [a] is given before (line 2, 3); the last one holds"
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x: 1\n", "printer.cfg:1: option 'x' stands outside of a section; put a [section] before it"),
        ("[a\n", "printer.cfg:1: '[a' is not a section header; write [name] or [name instance]"),
        ("[]\n", "printer.cfg:1: '[]' is not a section header; write [name] or [name instance]"),
        ("[a] b\n", "printer.cfg:1: '[a] b' is not a section header; write [name] or [name instance]"),
        (
            "[a]\nhello\n",
            "printer.cfg:2: 'hello' is neither a section header nor an option; write 'option: value'",
        ),
        (
            "[a]\n: 1\n",
            "printer.cfg:2: ': 1' is neither a section header nor an option; write 'option: value'",
        ),
        (b"[a]\nx: \0\n", "printer.cfg:2: a NUL byte: this is not a text file"),
        (b"[a]\nx: \xff\n", "printer.cfg:2: byte 0xff is not UTF-8 text; save the file as UTF-8"),
        ("[include]\n", "printer.cfg:1: [include] needs a file name: [include other.cfg]"),
        ("\n[include no.cfg]\n", "printer.cfg:2: cannot read 'no.cfg': No such file or directory"),
        ("[include .]\n", "printer.cfg:1: cannot read '.': Not a regular file"),
        ("[include /dev/zero]\n", "printer.cfg:1: cannot read '/dev/zero': Not a regular file"),
        ("[include printer.cfg]\n", "printer.cfg:1: 'printer.cfg' includes itself"),
    ],
)
def test_what_is_not_a_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | bytes, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        parse_config("printer.cfg")
    assert str(error.value) == sentence


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"printer\.cfg: cannot read '.*': No such file or directory$"):
        parse_config(str(tmp_path / "printer.cfg"))


def test_includes_are_relative_to_their_file_and_sorted(tmp_path: Path) -> None:
    write(tmp_path, "[include more/*.cfg]\n[z]\nx: 3\n", "sub/first.cfg")
    write(tmp_path, "[b]\nx: 2\n", "sub/more/2.cfg")
    write(tmp_path, "[a]\nx: 1\n", "sub/more/1.cfg")
    write(tmp_path, "not a configuration", "sub/more/.hidden.cfg")
    write(tmp_path, "[c]\nx: 4\n", "deep/d/c.cfg")
    config = parse(
        tmp_path, "[include sub/first.cfg]\n[include */?/[a-c].cfg]\n[include none*.cfg]\n[a]\ny: 5\n"
    )
    assert list(config.sections) == ["a", "b", "z", "c"]
    assert values(config)["a"] == {"x": "1", "y": "5"}
    assert str(config.sections["b"].options["x"].place) == f"{tmp_path}/sub/more/2.cfg:2"


def test_one_file_may_be_included_twice_but_not_by_itself(tmp_path: Path) -> None:
    write(tmp_path, "[a]\nx: 1\n", "a.cfg")
    assert values(parse(tmp_path, "[include a.cfg]\n[include a.cfg]\n")) == {"a": {"x": "1"}}
    write(tmp_path, "[include printer.cfg]\n", "a.cfg")
    assert refused(tmp_path, "[include a.cfg]\n") == "a.cfg:1: 'printer.cfg' includes itself"


def test_an_option_after_an_include_needs_a_section(tmp_path: Path) -> None:
    write(tmp_path, "[a]\n", "a.cfg")
    assert refused(tmp_path, "[b]\n[include a.cfg]\nx: 1\n").startswith(
        "printer.cfg:3: option 'x' stands outside"
    )


def test_include_bombs_end_soon(tmp_path: Path) -> None:
    for level in range(20):
        write(tmp_path, f"[include {level + 1}.cfg]\n" * 2, f"{level}.cfg")
    assert "included more than 16 deep" in refused(tmp_path, "[include 0.cfg]\n")
    write(tmp_path, "", "12.cfg")  # 2^12 files now
    assert "more than 200 files are included" in refused(tmp_path, "[include 0.cfg]\n")


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole: takes no room
    with pytest.raises(ConfigError, match=r"larger than 2 MB in all$"):
        parse_config(str(path))


def test_what_a_file_is_going_to_hold_is_read_and_counted(tmp_path: Path) -> None:
    path = write(tmp_path, "[printer]\n", "printer.cfg")
    write(tmp_path, "[later]\n", "later.cfg")
    assert [*parse_config(str(path), data=b"[include later.cfg]\n").sections] == ["later"]
    with pytest.raises(ConfigError, match=r"larger than 2 MB in all$"):
        parse_config(str(path), data=b"\n" * 2_000_001)


def test_a_pattern_over_too_many_files_is_refused(tmp_path: Path) -> None:
    budget = config_text.ReadBudget(directory_entries=10)
    for number in range(11):
        write(tmp_path, "", f"{number}.txt")
    place = Place(f"{tmp_path}/printer.cfg", 7)
    with pytest.raises(ConfigError, match=r"printer\.cfg:7: the pattern searches too many files"):
        config_text.included_paths("*.cfg", place, budget)


SAVED = """\
[extruder]
control: pid
pid_kp: 1   # mine

#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [extruder]
#*# pid_kp = 22.5
#*#
#*# [bed_mesh default]
#*# points =
#*# 	  0.1, 0.2
#*# 	  0.3, 0.4
"""


def test_saved_values_override_and_the_users_text_is_kept(tmp_path: Path) -> None:
    config = parse(tmp_path, SAVED)
    assert values(config) == {
        "extruder": {"control": "pid", "pid_kp": "22.5"},
        "bed_mesh default": {"points": "0.1, 0.2\n0.3, 0.4"},
    }
    assert config.sections["extruder"].options["pid_kp"].place.line == 9
    assert config.data == SAVED.encode()
    assert list(config.saved["extruder"].options) == ["pid_kp"]


def test_text_below_the_saved_block_is_refused(tmp_path: Path) -> None:
    assert refused(tmp_path, SAVED + "\n[fan]\n") == (
        "printer.cfg:16: text below the SAVE_CONFIG block of line 5; move it above the block"
    )


def test_a_saved_block_cannot_include(tmp_path: Path) -> None:
    assert refused(tmp_path, SAVED + "#*# [include x.cfg]\n") == (
        "printer.cfg:15: the SAVE_CONFIG block cannot include files"
    )


def test_the_saved_block_of_an_included_file_is_noted(tmp_path: Path) -> None:
    write(tmp_path, SAVED, "old.cfg")
    config = parse(tmp_path, "[include old.cfg]\n")
    assert values(config) == {"extruder": {"control": "pid", "pid_kp": "1"}}
    assert config.notes == [f"{tmp_path}/old.cfg:5: the SAVE_CONFIG block of an included file is not read"]


PIECES = st.sampled_from(
    [
        "[",
        "]",
        ":",
        "=",
        "#",
        ";",
        " ",
        "\n",
        "\t",
        "\r",
        "#*#",
        "include",
        "printer.cfg",
        "*",
        "a",
        "\x0b",
        "\u2028",
    ]
)


@settings(max_examples=examples(300))
@given(
    data=st.one_of(st.binary(max_size=200), st.lists(PIECES, max_size=40).map(lambda p: "".join(p).encode()))
)
def test_whatever_the_file_holds_only_a_sentence_comes_back(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = write(tmp_path_factory.getbasetemp(), data)
    try:
        config = parse_config(path)
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017
        assert str(error).isprintable()  # noqa: PT017
    else:
        for section in config.sections.values():
            for option in section.options.values():
                assert option.value == option.value.strip()
                assert option.place.line >= 1
