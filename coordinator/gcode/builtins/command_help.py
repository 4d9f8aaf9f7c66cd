"""Help of the commands that every machine has, each a sentence without a full stop."""

from collections.abc import Mapping
from typing import Final

BUILTIN_HELP: Final[Mapping[str, str]] = {
    "ACTIVATE_EXTRUDER": "Make EXTRUDER the one that E moves",
    "G0": "Move to X Y Z E at F mm/min",
    "G1": "Move to X Y Z E at F mm/min",
    "G17": "Select the plane of X and Y for arcs",
    "G18": "Select the plane of Z and X for arcs",
    "G19": "Select the plane of Y and Z for arcs",
    "G2": "Move along an arc, clockwise",
    "G20": "Set the unit to inches",
    "G21": "Set the unit to millimetres",
    "G28": "Home X, Y, Z, or all axes",
    "G3": "Move along an arc, counter-clockwise",
    "G4": "Wait P milliseconds or S seconds",
    "G90": "Use absolute positions",
    "G91": "Use relative positions",
    "G92": "Set the position that the program reads to X Y Z E, without moving",
    "GET_POSITION": "Report the position in all frames",
    "M112": "Stop all nodes at once",
    "M114": "Report the position that the next move begins at",
    "M118": "Show a line",
    "M201": "Limit the acceleration of the axes to X Y Z E, mm/s²",
    "M203": "Limit the speed of the axes to X Y Z E, mm/s",
    "M205": "Set the speed at corners, the lesser of X and Y",
    "M204": "Set the acceleration, mm/s²: S, P of moves with filament, T of others",
    "M220": "Set the speed factor, S %",
    "M221": "Set the extrusion factor, S %",
    "M400": "Wait until all moves are carried out",
    "M82": "Use absolute positions for E",
    "M83": "Use relative positions for E",
    "RESTORE_GCODE_STATE": "Restore what SAVE_GCODE_STATE saved: NAME, MOVE, MOVE_SPEED",
    "RESTORE_DUAL_CARRIAGE_STATE": "Restore what SAVE_DUAL_CARRIAGE_STATE saved: NAME, MOVE, MOVE_SPEED",
    "SAVE_DUAL_CARRIAGE_STATE": "Save the modes of both carriages under NAME",
    "SAVE_GCODE_STATE": "Save modes, origin, factors and position under NAME",
    "SET_DUAL_CARRIAGE": "Choose CARRIAGE 0 or 1, and its MODE",
    "SET_EXTRUDER_ROTATION_DISTANCE": "Set the way per turn of EXTRUDER to DISTANCE mm, or report it",
    "SET_GCODE_OFFSET": "Shift the origin: X Y Z E, X_ADJUST …, MOVE, MOVE_SPEED",
    "SET_INPUT_SHAPER": "Set SHAPER_TYPE_X, SHAPER_FREQ_X, DAMPING_RATIO_X …, or report them",
    "SET_PRESSURE_ADVANCE": "Set ADVANCE and SMOOTH_TIME of EXTRUDER, or report them",
    "SET_VELOCITY_LIMIT": "Set VELOCITY, ACCEL, SQUARE_CORNER_VELOCITY, MINIMUM_CRUISE_RATIO",
    "TUNING_TOWER": "Vary PARAMETER of COMMAND with the height of the print: START, FACTOR, BAND, SKIP,"
    " STEP_DELTA, STEP_HEIGHT",
    "SYNC_EXTRUDER_MOTION": "Synchronize the stepper EXTRUDER with the extruder MOTION_QUEUE",
}
"""Commands that only a module makes useful (M104, M84) have their help there."""
