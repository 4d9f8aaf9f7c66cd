"""The configuration of a node: object ids, configuration and init commands, checked when added."""

import zlib
from collections.abc import Iterable
from typing import Final

from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import MessageError
from nodes.dictionary.vocabulary import carries
from nodes.support.errors import CanductorError

MAX_OIDS: Final = 255
"""Object ids are one byte, and so is their count."""


class NodeConfigError(CanductorError):
    """A node cannot be configured as the machine needs it."""


class NodeConfig:
    """Collects the commands that configure node NAME. Every command is checked against DICTIONARY."""

    def __init__(self, name: str, dictionary: Dictionary) -> None:
        self.name = name
        self.dictionary = dictionary
        self.oid_count = 0
        self.timed_outputs = 0
        """Number of outputs whose values wait in the node's move queue; increment it when adding one."""
        self._config: list[str] = []
        self._init: list[str] = []

    def create_oid(self) -> int:
        """Return a new object id, 0..254; raises NodeConfigError when there is none left."""
        if self.oid_count >= MAX_OIDS:
            raise NodeConfigError(f"node {self.name} would have more than {MAX_OIDS} objects; move some")
        self.oid_count += 1
        return self.oid_count - 1

    def require(self, feature: str, commands: Iterable[str], responses: Iterable[str] = ()) -> None:
        """Raise NodeConfigError naming what FEATURE needs and the firmware lacks.

        RESPONSES are formats; see ``carries``.
        """
        missing = [name for name in commands if name not in self.dictionary.commands]
        missing += [f"response '{text}'" for text in responses if not carries(self.dictionary, text)]
        if missing:
            raise NodeConfigError(
                f"{feature} cannot work on node {self.name}: its firmware ({self.dictionary.version}) has no "
                f"{', '.join(missing)}; flash firmware built with it"
            )

    def add_config(self, feature: str, command: str) -> None:
        """Add a configuration command as text; raises NodeConfigError naming FEATURE."""
        self._config.append(self._checked(feature, command))

    def add_init(self, feature: str, command: str) -> None:
        """Add a command to be sent at every start, after the configuration; raises NodeConfigError."""
        self._init.append(self._checked(feature, command))

    def _checked(self, feature: str, command: str) -> str:
        self.require(feature, [command.partition(" ")[0]])
        try:
            self.dictionary.encode_text(command)
        except MessageError as error:
            raise NodeConfigError(f"{feature} on node {self.name}: {error}") from None
        return command

    @property
    def config_commands(self) -> tuple[str, ...]:
        """All configuration commands in order, without the closing finalize_config."""
        return (f"allocate_oids count={self.oid_count}", *self._config)

    @property
    def init_commands(self) -> tuple[str, ...]:
        """The commands to be sent after the configuration."""
        return tuple(self._init)

    @property
    def crc(self) -> int:
        """CRC-32 of the text of the configuration commands: identifies the configuration."""
        return zlib.crc32("\n".join(self.config_commands).encode())
