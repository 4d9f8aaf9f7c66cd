"""Templates: what they make, where each line of it comes from, and that nothing they do is without bounds."""

import pytest

from coordinator.gcode.templates.templates import Asked, Template, TemplateError

DOUBLING = "{% set n = namespace(s='ab') %}{% for i in range(99) %}"


def render(text: str, **values: object) -> str:
    return Template(text).render(values).text


def test_values_statements_and_comments() -> None:
    text = "{% set x = params.X|default(10)|float %}\n{# a comment #}\nG1 X{x} {'%.2f' % x} {x ~ 'a'}"
    assert render(text, params={"X": "12"}).splitlines()[-1] == "G1 X12.0 12.00 12.0a"
    assert render(text, params={}).splitlines()[-1] == "G1 X10.0 10.00 10.0a"
    assert render("{% set l = [] %}{% do l.append(3) %}{ l|join(',') }{ {'a': 1}['a'] }") == "31"
    assert render("{% for i in a if i > 1 %}{loop.index}/{loop.length}:{i} {% endfor %}", a=[1, 2, 3]) == (
        "1/2:2 2/2:3 "
    )


def test_without_braces_a_text_is_what_it_is() -> None:
    made = Template("G28\n\nG1 X5 ; %}").render({})
    assert (made.text, made.lines) == ("G28\n\nG1 X5 ; %}", (1, 2, 3))


def test_every_line_knows_where_it_comes_from() -> None:
    text = (
        "A\n{% for i in range(2) %}\nB{i}\n{% endfor %}\n{% if 0 %}\nC\n{% else %}\nD\n{% endif %}\nE{x}\nF"
    )
    made = Template(text).render({"x": "1\nsecond"})
    by_line = dict(zip(made.text.split("\n"), made.lines, strict=True))
    assert {line: by_line[line] for line in ("A", "B0", "B1", "D", "E1", "second", "F")} == {
        "A": 1, "B0": 3, "B1": 3, "D": 8, "E1": 10, "second": 10, "F": 11,
    }  # fmt: skip


def test_texts_that_a_template_keeps_hold_no_marks() -> None:
    text = "{% set kept %}\nab\n{% endset %}\n{% macro m() %}\nx\n{% endmacro %}{kept|length} {m()|length}"
    assert render(text).endswith("4 3")


@pytest.mark.parametrize(
    ("text", "line", "part"),
    [
        ("\n{% if %}", 2, "Expected an expression"),
        ("\n\n{% if 1 %}", 3, "endif"),
        ("G1 X{", 1, "unexpected 'end of template'"),
        ("\n{ 1|nofilter }", 2, "nofilter"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_line(text: str, line: int, part: str) -> None:
    with pytest.raises(TemplateError) as error:
        Template(text).render({})
    assert error.value.line == line
    assert part in str(error.value)


@pytest.mark.parametrize(
    ("text", "line", "part"),
    [
        ("{ 1 / 0 }", 1, "division by zero"),
        ("\n{ a.b.c }", 2, "'a' is undefined"),
        ("\n{ x + 1 }", 2, "str"),
        ("\n\n{ 'a'|int + [] }", 3, "list"),
        ("{ ''.__class__.__mro__ }", 1, "unsafe"),
        ("{ x.__class__.__base__.__subclasses__() }", 1, "unsafe"),
        ("{ action_respond_info.__globals__.os }", 1, "unsafe"),
        ("{ (''|attr('__class__'))() }", 1, "unsafe"),
        ("{ '{0.__class__.__mro__}'.format(x) }", 1, "unsafe"),
        ("{% include '/etc/passwd' %}", 1, "no loader"),
        ("{% import 'os' as os %}", 1, "no loader"),
    ],
)
def test_what_goes_wrong_is_told_with_its_line(text: str, line: int, part: str) -> None:
    with pytest.raises(TemplateError) as error:
        render(text, x="word")
    assert error.value.line == line
    assert part in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "{% for i in range(100000) %}{% for j in range(100000) %}{% endfor %}{% endfor %}",
        "{% for i in range(1000000000) %}{% endfor %}",
        "{% set l = [1] %}{% for i in l %}{% do l.append(1) %}{% endfor %}",
        "{% macro a(n) %}{a(n)}{% endmacro %}{a(1)}",
        "{% macro a(n) %}{% if n %}{a(n-1)}{a(n-1)}{% endif %}{% endmacro %}{a(100)}",
        "{% for i in range(99999) %}{'0123456789012345'}{% endfor %}",
        "{ 'a' * 10**9 }",
        "{ 10**9 * [0] }",
        "{ 2**(10**9) }",
        "{% set n = namespace(x=3) %}{% for i in range(99) %}{% set n.x = n.x * n.x %}{% endfor %}",
        "{% set n = namespace(s='ab') %}{% for i in range(99) %}{% set n.s = n.s ~ n.s %}{% endfor %}",
        "{% set n = namespace(s='ab') %}{% for i in range(99) %}{% set n.s = n.s + n.s %}{% endfor %}",
        "{% set n = namespace(s=[1]) %}{% for i in range(99) %}{% set n.s = n.s + n.s %}{% endfor %}",
        DOUBLING + "{% set n.s = n.s.replace('a', 'aa') %}{% endfor %}",
        DOUBLING + "{% set n.s = n.s|replace('a', 'aa') %}{% endfor %}",
        DOUBLING + "{% set n.s %}{n.s}{n.s}{% endset %}{% endfor %}",
        "{% set n = namespace(s='ab') %}{% for i in range(99) %}{% set n.s = [n.s, n.s]|join %}{% endfor %}",
        DOUBLING + "{% set n.s = n.s.join([n.s, n.s]) %}{% endfor %}",
        "{ '%999999999d' % 1 }",
        "{ '%*d' % (999999999, 1) }",
        "{ '%999999999d'|format(1) }",
        "{ '{:>999999999}'.format(1) }",
        "{ '{:>{}}'.format(1, 999999999) }",
        "{ 'a'.ljust(999999999) }",
        "{ 'a'.zfill(999999999) }",
        "{ 'a'|center(999999999) }",
        "{ 'a'|indent(999999999, true) }",
        "{ [1]|batch(999999999, 0)|list }",
        "{ [1]|slice(999999999)|list }",
        "{ {'a': 1}|tojson(999999999) }",
    ],
)
def test_whatever_would_not_end_ends_with_a_sentence(text: str) -> None:
    with pytest.raises(TemplateError):
        render(text)


def test_a_template_can_end_itself_and_what_it_asked_for_before_is_known() -> None:
    with pytest.raises(Asked, match="no filament") as asked:
        render("{action_respond_info(1)}{% if 1 %}{action_raise_error('no filament')}{% endif %}")
    assert (asked.value.actions, asked.value.emergency) == ((("respond", "1"),), False)
    with pytest.raises(Asked, match="hot") as asked:
        render("{action_emergency_stop('hot')}")
    assert asked.value.emergency
    with pytest.raises(TemplateError) as error:
        render("{action_call_remote_method('light', on=[1, (2,)], name='x')}{ 1 / 0 }")
    assert error.value.actions == (("call", "light", {"on": [1, [2]], "name": "x"}),)
    assert render("{ 1 }") == "1"
