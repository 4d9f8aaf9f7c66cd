"""One reader per kinematics: from [printer] and its stepper sections to the frame of the machine."""
