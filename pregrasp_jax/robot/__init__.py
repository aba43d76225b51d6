"""UR5e arm with an RG2 gripper: MJCF, kinematics, drawn links, clearance and the closing region.

Everything numeric about the robot is written once, in ``mjcf/``, and read from there.
"""
