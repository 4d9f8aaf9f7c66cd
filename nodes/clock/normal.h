// SPDX-License-Identifier: Apache-2.0
// The normal distribution, cut off on one side.
#ifndef NORMAL_H
#define NORMAL_H

// cffi: begin
// Returns φ(k)/Φ(k), for any K without underflow.
double normal_hazard(double k);
// cffi: end

#endif
