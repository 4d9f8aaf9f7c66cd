"""What the commands that every machine has do, each in a sentence without a full stop."""

from collections.abc import Mapping
from typing import Final

HELPS: Final[Mapping[str, str]] = {
    "ACTIVATE_EXTRUDER": "Let E move EXTRUDER",
    "G0": "Move to X Y Z E at F mm/min",
    "G1": "Move to X Y Z E at F mm/min",
    "G17": "Have arcs in the plane of X and Y",
    "G18": "Have arcs in the plane of Z and X",
    "G19": "Have arcs in the plane of Y and Z",
    "G2": "Move along an arc, clockwise",
    "G20": "Have numbers in inches",
    "G21": "Have numbers in millimetres",
    "G28": "Home X, Y, Z, or all axes",
    "G3": "Move along an arc, counter-clockwise",
    "G4": "Wait P milliseconds or S seconds",
    "G90": "Have X Y Z as places",
    "G91": "Have X Y Z as distances",
    "G92": "Have the place where the head is read as X Y Z E",
    "GET_POSITION": "Tell the position in all frames",
    "M112": "Stop all nodes at once",
    "M114": "Tell the position that the next move begins at",
    "M118": "Show a line",
    "M204": "Set the acceleration, S mm/s², or the lesser of P and T",
    "M220": "Set the speed factor, S %",
    "M221": "Set the extrusion factor, S %",
    "M400": "Wait until all moves are carried out",
    "M82": "Have E as a place",
    "M83": "Have E as a distance",
    "RESTORE_GCODE_STATE": "Let all be as SAVE_GCODE_STATE found it: NAME, MOVE, MOVE_SPEED",
    "SAVE_GCODE_STATE": "Keep modes, origin, factors and position under NAME",
    "SET_DUAL_CARRIAGE": "Choose CARRIAGE 0 or 1, and its MODE",
    "SET_GCODE_OFFSET": "Shift the origin: X Y Z E, X_ADJUST …, MOVE, MOVE_SPEED",
    "SET_INPUT_SHAPER": "Set SHAPER_TYPE_X, SHAPER_FREQ_X, DAMPING_RATIO_X …, or tell them",
    "SET_PRESSURE_ADVANCE": "Set ADVANCE and SMOOTH_TIME of EXTRUDER, or tell them",
    "SET_VELOCITY_LIMIT": "Set VELOCITY, ACCEL, SQUARE_CORNER_VELOCITY, MINIMUM_CRUISE_RATIO",
    "SYNC_EXTRUDER_MOTION": "Let the stepper EXTRUDER move with the extruder MOTION_QUEUE",
}
"""Those that only become useful with a module (M104, M84) are told by it."""
