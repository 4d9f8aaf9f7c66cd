"""[axis_tables]: that axes may have compensation tables, and how long these may be."""

from coordinator.config.model import AxisTablesDescription
from coordinator.config.options import IntOption, SectionReader, SectionSpec
from coordinator.config.sections.reading import Reading

POINTS = IntOption(
    name="points",
    help="room of each table; a node needs 48 bytes for a point of each of its axes",
    default=128,
    minimum=2,
    maximum=10_000,
)
AXIS_TABLES = SectionSpec(
    help="Axes may have compensation tables (docs/tables.md); nodes of this project's firmware keep them too",
    options=(POINTS,),
)


def read_axis_tables(reading: Reading) -> AxisTablesDescription | None:
    """Return it; raises ConfigError."""
    section = reading.find("axis_tables")
    if section is None:
        return None
    reader = SectionReader(section, AXIS_TABLES)
    points = reader.get(POINTS)
    reading.finish(reader)
    return AxisTablesDescription(points, section.place)
