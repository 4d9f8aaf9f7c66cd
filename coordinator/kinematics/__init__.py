"""A file per kinematics: formulas both ways, work space, homing order, and what step generation needs."""
