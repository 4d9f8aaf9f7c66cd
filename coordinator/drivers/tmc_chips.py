"""Registers and fields of stepper drivers, from the data sheets of Trinamic (Analog Devices).

TMC2208/TMC2202/TMC2224 rev. 1.13, TMC2209 rev. 1.09: chapter "Register Map".
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Field:
    """Some bits of a register: COUNT of them from SHIFT on."""

    name: str
    shift: int
    count: int = 1

    @property
    def maximum(self) -> int:
        """The largest value."""
        return (1 << self.count) - 1

    def of(self, register: int) -> int:
        """Return the value in a register."""
        return register >> self.shift & self.maximum

    def put(self, register: int, value: int) -> int:
        """Return a register with VALUE in it, which must fit."""
        assert 0 <= value <= self.maximum, self.name
        return register & ~(self.maximum << self.shift) | value << self.shift


@dataclass(frozen=True, slots=True)
class Register:
    """One register."""

    name: str
    address: int
    fields: tuple[Field, ...] = ()
    readable: bool = True
    writable: bool = False

    def field(self, name: str) -> Field:
        """Return a field by its name, which must exist."""
        return next(field for field in self.fields if field.name == name)


@dataclass(frozen=True, slots=True)
class Chip:
    """One kind of driver."""

    name: str
    """As sections are named: ``tmc2209``."""
    version: int
    """Of IOIN."""
    addresses: int
    """How many may be on one wire."""
    has_stallguard: bool
    """Whether it can feel that the motor stands against something."""
    registers: Mapping[str, Register]

    def field_register(self, name: str) -> Register | None:
        """Return the register that a field called NAME (in any case) can be written in, or None."""
        for register in self.registers.values():
            if register.writable and any(field.name == name.lower() for field in register.fields):
                return register
        return None

    @property
    def writable_fields(self) -> tuple[str, ...]:
        """Names of all fields that can be written."""
        return tuple(f.name for r in self.registers.values() if r.writable for f in r.fields)


FAULTS: Final[Mapping[str, str]] = {
    "ot": "is too hot and switched itself off; lower run_current, cool it, let it cool down",
    "s2ga": "reports a short circuit to ground at coil A; check motor and cable",
    "s2gb": "reports a short circuit to ground at coil B; check motor and cable",
    "s2vsa": "reports a short circuit at coil A; check motor and cable",
    "s2vsb": "reports a short circuit at coil B; check motor and cable",
}
"""Fields of DRV_STATUS with which a machine must not go on."""
UNDERVOLTAGE: Final = "has too low a motor supply; check the power supply and its wiring"
FORGOTTEN: Final = "has lost its settings: its motor supply was off for a moment; check the power supply"


def _bits(first: int, names: str) -> tuple[Field, ...]:
    """Return fields of one bit each, from bit FIRST on."""
    return tuple(Field(name, shift) for shift, name in enumerate(names.split(), first))


def _registers(*registers: Register) -> dict[str, Register]:
    return {register.name: register for register in sorted(registers, key=lambda one: one.address)}


_GCONF: Final = Register(
    "GCONF",
    0x00,
    _bits(
        0,
        "i_scale_analog internal_rsense en_spreadcycle shaft index_otpw index_step pdn_disable"
        " mstep_reg_select multistep_filt test_mode",
    ),
    writable=True,
)
_COMMON: Final = (
    Register("GSTAT", 0x01, (Field("reset", 0), Field("drv_err", 1), Field("uv_cp", 2))),
    Register("IFCNT", 0x02, (Field("ifcnt", 0, 8),)),
    Register("SLAVECONF", 0x03, (Field("senddelay", 8, 4),), readable=False, writable=True),
    Register("OTP_READ", 0x05),
    Register("FACTORY_CONF", 0x07, (Field("fclktrim", 0, 5), Field("ottrim", 8, 2)), writable=True),
    Register(
        "IHOLD_IRUN",
        0x10,
        (Field("ihold", 0, 5), Field("irun", 8, 5), Field("iholddelay", 16, 4)),
        readable=False,
        writable=True,
    ),
    Register("TPOWERDOWN", 0x11, (Field("tpowerdown", 0, 8),), readable=False, writable=True),
    Register("TSTEP", 0x12, (Field("tstep", 0, 20),)),
    Register("TPWMTHRS", 0x13, (Field("tpwmthrs", 0, 20),), readable=False, writable=True),
    Register("VACTUAL", 0x22, (Field("vactual", 0, 24),), readable=False, writable=True),
    Register("MSCNT", 0x6A, (Field("mscnt", 0, 10),)),
    Register("MSCURACT", 0x6B, (Field("cur_a", 0, 9), Field("cur_b", 16, 9))),
    Register(
        "CHOPCONF",
        0x6C,
        (
            Field("toff", 0, 4),
            Field("hstrt", 4, 3),
            Field("hend", 7, 4),
            Field("tbl", 15, 2),
            Field("vsense", 17),
            Field("mres", 24, 4),
            *_bits(28, "intpol dedge diss2g diss2vs"),
        ),
        writable=True,
    ),
    Register(
        "DRV_STATUS",
        0x6F,
        (
            *_bits(0, "otpw ot s2ga s2gb s2vsa s2vsb ola olb t120 t143 t150 t157"),
            Field("cs_actual", 16, 5),
            *_bits(30, "stealth stst"),
        ),
    ),
    Register(
        "PWMCONF",
        0x70,
        (
            Field("pwm_ofs", 0, 8),
            Field("pwm_grad", 8, 8),
            Field("pwm_freq", 16, 2),
            Field("pwm_autoscale", 18),
            Field("pwm_autograd", 19),
            Field("freewheel", 20, 2),
            Field("pwm_reg", 24, 4),
            Field("pwm_lim", 28, 4),
        ),
        writable=True,
    ),
    Register("PWM_SCALE", 0x71, (Field("pwm_scale_sum", 0, 8), Field("pwm_scale_auto", 16, 9))),
    Register("PWM_AUTO", 0x72, (Field("pwm_ofs_auto", 0, 8), Field("pwm_grad_auto", 16, 8))),
)


def _ioin(spread: str) -> Register:
    fields = (
        *(Field("enn", 0), Field("ms1", 2), Field("ms2", 3), Field("diag", 4), Field("pdn_uart", 6)),
        *(Field("step", 7), Field(spread, 8), Field("dir", 9), Field("version", 24, 8)),
    )
    return Register("IOIN", 0x06, fields)


TMC2208: Final = Chip("tmc2208", 0x20, 1, False, _registers(_GCONF, *_COMMON, _ioin("sel_a")))
TMC2209: Final = Chip(
    "tmc2209",
    0x21,
    4,
    True,
    _registers(
        _GCONF,
        *_COMMON,
        _ioin("spread_en"),
        Register("TCOOLTHRS", 0x14, (Field("tcoolthrs", 0, 20),), readable=False, writable=True),
        Register("SGTHRS", 0x40, (Field("sgthrs", 0, 8),), readable=False, writable=True),
        Register("SG_RESULT", 0x41, (Field("sg_result", 0, 10),)),
        Register(
            "COOLCONF",
            0x42,
            (
                Field("semin", 0, 4),
                Field("seup", 5, 2),
                Field("semax", 8, 4),
                Field("sedn", 13, 2),
                Field("seimin", 15),
            ),
            readable=False,
            writable=True,
        ),
    ),
)
CHIPS: Final[Mapping[str, Chip]] = {chip.name: chip for chip in (TMC2208, TMC2209)}


def shown(register: Register, value: int) -> str:
    """Return a register's VALUE for people: hexadecimal, then its fields that are not 0."""
    fields = " ".join(f"{field.name}={of}" for field in register.fields if (of := field.of(value)))
    return f"{register.name}: {value:08x} {fields}".rstrip()
