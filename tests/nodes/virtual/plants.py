"""Plants that several tests use."""

from nodes.virtual.plant import Beta, Body, Fan, Heater, NodePlant, Sensor

HOT = NodePlant(
    node="hot",
    ambient=20.0,
    bodies=(Body(name="block", capacity=2.0, loss=0.4),),
    heaters=(Heater(name="block", pin="PA0", body="block", power=90.0),),
    fans=(Fan(name="part", pin="PA1", lag=0.05, tach_pin="PB1"),),
    sensors=(Sensor(name="block", pin="PB0", node="hot", body="block", curve=Beta(beta=3950.0), lag=0.15),),
)
"""A block of little heat: it is warm within a second."""
