// SPDX-License-Identifier: Apache-2.0
// What the planner hands to step generation: one move as a function of print time.
#ifndef MOTION_TRAPEZOID_H
#define MOTION_TRAPEZOID_H

#include <stdint.h>

// cffi: begin
enum { AXIS_X, AXIS_Y, AXIS_Z, AXIS_E, AXES };

// A straight move in three phases of constant acceleration; any phase may last 0 s. The way s(t) along the
// move is
//   accelerate: start_v·t + accel·t²/2     cruise: cruise_v·t     decelerate: cruise_v·t − accel·t²/2
// and the position of axis i is start[i] + ratio[i]·s. s is measured along X, Y, Z, or along E where those
// stand. Moves follow each other without gaps except where the machine stands still.
struct trapezoid {
    double print_time;                 // s, begin of the move
    double accel_s, cruise_s, decel_s; // s, duration of each phase
    double start_v, cruise_v;          // mm/s
    double accel;                      // mm/s², >= 0
    double start[4];                   // mm, X Y Z E
    double ratio[4];                   // mm per mm of s
    double pressure_advance;           // s, of the extruder that E stands for
    int64_t line;                      // of the program; 0: none
};
// cffi: end

#endif
