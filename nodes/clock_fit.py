"""The filter behind a clock's estimate: a node's lead over host time, from bounds on either side."""

import math
from typing import Final

SIZE: Final = 5
LEAD, RATE, CURVATURE, DELAY, SKEW = range(SIZE)
P = dict(rate0=2e-4, curv=1.2e-8, tau=150.0, qr=1e-10, qb=0.1, floor=0.1, soft=7.0, late=16, askew=1.0, sdecay=1000.0)


def hazard(k: float) -> float:
    """Return φ(k)/Φ(k) of the normal distribution, for any K without underflow."""
    if k < -25.0:
        return -k - 1 / k
    return math.exp(-k * k / 2) * 0.3989422804014327 / (0.5 * math.erfc(-k * 0.7071067811865476))


class Filter:
    def __init__(self, lead_s: float, round_trip_s: float) -> None:
        base = round_trip_s / 4
        self.x = [lead_s, 0.0, 0.0, base, 0.0]
        self.p = [[0.0] * SIZE for _ in range(SIZE)]
        self.p[0][0] = base**2 * 4 / 3
        self.p[1][1] = P["rate0"] ** 2
        self.p[2][2] = P["curv"] ** 2
        self.p[3][3] = base**2 / 3

    def predict(self, dt: float, spread: float) -> None:
        x, p = self.x, self.p
        phi = math.exp(-dt / P["tau"])
        half = dt * dt / 2
        x[0] += x[1] * dt + x[2] * half
        x[1] += x[2] * dt
        x[2] *= phi
        relax = math.exp(-dt / P["sdecay"])
        x[4] *= relax
        for row in p:
            row[0] += row[1] * dt + row[2] * half
            row[1] += row[2] * dt
            row[2] *= phi
            row[4] *= relax
        p0, p1, p2, p4 = p[0], p[1], p[2], p[4]
        for i in range(SIZE):
            p0[i] += p1[i] * dt + p2[i] * half
            p1[i] += p2[i] * dt
            p2[i] *= phi
            p4[i] *= relax
        q = P["qr"] ** 2 * dt
        p0[0] += q * dt * dt / 3
        p0[1] += q * dt / 2
        p1[0] += q * dt / 2
        p1[1] += q
        p2[2] += P["curv"] ** 2 * (1 - phi * phi)
        # process noise of base: fraction of the spread per sqrt(100 s)
        p[3][3] += (P["qb"] * spread) ** 2 * dt / 100

    def slack(self, sign: int, bound: float) -> float:
        x = self.x
        return bound - (sign * (x[0] + x[4]) + x[3])

    def bound(self, sign: int, bound: float, spread: float) -> float:
        """sign*(lead+skew)+delay <= bound, exponential with mean SPREAD below it."""
        p, x = self.p, self.x
        ph = [sign * (row[0] + row[4]) + row[3] for row in p]
        v = sign * (ph[0] + ph[4]) + ph[3]
        gap = bound - (sign * (x[0] + x[4]) + x[3])
        noise = (P["floor"] * spread) ** 2
        s = math.sqrt(v + noise)
        if gap < -4 * s:
            # faster than believed possible: the line's fastest has changed in this direction
            d = gap * gap / 4
            p[3][3] += d
            p[4][4] += d
            p[3][4] += sign * d
            p[4][3] += sign * d
            ph = [sign * (row[0] + row[4]) + row[3] for row in p]
            v = sign * (ph[0] + ph[4]) + ph[3]
            s = math.sqrt(v + noise)
        pull = 1 / spread if gap < P["soft"] * spread else 0.0
        k = gap / s - pull * s
        r = hazard(k)
        push = pull - r / s
        cut = max(r * (k + r), 0.0) / (s * s)
        cut = min(cut, 1 / (s * s))
        for i in range(SIZE):
            x[i] += ph[i] * push
            g = ph[i] * cut
            row = p[i]
            for j in range(SIZE):
                row[j] -= g * ph[j]

    def later(self, sign: int, by: float) -> None:
        """The line has become slower in one direction."""
        x, p = self.x, self.p
        x[3] += by / 2
        x[4] += sign * by / 2
        d = by * by / 4 * P["askew"]**2
        p[3][3] += d
        p[4][4] += d
        p[3][4] += sign * d
        p[4][3] += sign * d
