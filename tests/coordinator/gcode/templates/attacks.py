"""Templates that hold whoever renders them: single calls that take long, or much memory."""

from typing import Final

MILLION: Final = "{% set m = '0123456789' * 90000 %}"
"""A text of nearly as many characters as a template may build."""
NUMBERS: Final = "{% set l = range(90000)|list %}"
SHARED: Final = "{% set n = namespace(v=[1]) %}{% for i in range(60) %}{% set n.v = [n.v, n.v] %}{% endfor %}"
"""A list that is small, because its parts are the same one, and has 2^60 of them for who looks at each."""

SENTENCES: Final = (
    "of processor time; have it do less",
    "it needs too much memory; have it build less",
    "more than 1000000 characters",
)
"""What ends them; which of these comes first is a matter of the computer."""

ATTACKS: Final = {
    "nested comparison": (
        "{% set n = namespace(a=[1], b=[1]) %}{% for i in range(60) %}{% set n.a = [n.a, n.a] %}"
        "{% set n.b = [n.b, n.b] %}{% endfor %}{ n.a == n.b }"
    ),
    "tojson": (SHARED + "{ n.v|tojson|length }"),
    "str": (SHARED + "{ n.v|string|length }"),
    "action_call_remote_method": (SHARED + "{ action_call_remote_method('m', v=n.v) }"),
    "sum": ("{ (([[1] * 900] * 90000)|sum(start=[]))|length }"),
    "unique": (NUMBERS + "{% for i in range(9000) %}{ l|unique|list|length }{% endfor %}"),
    "in": (MILLION + "{% for i in range(90000) %}{% if (m ~ 'x') in m %}{% endif %}{% endfor %}"),
    "translate": (MILLION + "{ m.translate({48: m})|length }"),
    "expandtabs": ("{% set m = '\\t' * 900000 %}{ m.expandtabs(9000)|length }"),
    "indent": ("{% set m = '\\n' * 900000 %}{ m|indent(9000, true, true)|length }"),
    "wordwrap": ("{% set m = 'a b ' * 9000 %}{ m|wordwrap(1, wrapstring=m)|length }"),
    "format": ("{ ('%9999d' * 9000)|format(*range(9000))|length }"),
    "sort": (MILLION + "{% set l = [m ~ 'a', m ~ 'b'] * 40000 %}{ l|sort|length }"),
    "extend": ("{% set l = [1] * 900000 %}{% for i in range(90000) %}{% do l.extend(l) %}{% endfor %}"),
    "center": ("{% set l = [] %}{% for i in range(45000) %}{% do l.append('a'.center(9999)) %}{% endfor %}"),
    "append": ("{% set l = [] %}{% for i in range(900) %}{% do l.append([i] * 900000) %}{% endfor %}"),
    "action_respond_info": (
        MILLION + "{% for i in range(9000) %}{action_respond_info(m)}{% endfor %}"
    ),
}  # fmt: skip
"""Templates by what they call."""
