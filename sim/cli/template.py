"""The scene that ``pantograph new`` writes."""

TEMPLATE = """\
# A scene: what is in it, how it moves, how it is filmed.
#   pantograph run  this-file.toml --film wave.mp4 --plot wave.png --error
#   pantograph plan this-file.toml     explains how it will be computed
format = 1
title = "An arm that waves"
duration = 4.0        # seconds
angle = "degree"      # unit of all angles in this file; the default is "radian"

[[models]]
file = "arm6"         # a built-in model ('pantograph models'), or a path to MJCF or URDF
# or instead: chain = { links = 20, length = 1.0 }
# name = "left"       # with several models each needs a name, and its joints are "left/shoulder", ...
# position = [0, 0, 0]

# Joints with keys move exactly as keyed, without physics. Give joints to a controller, which pushes them
# along their keys with real forces, or leave them to physics alone:
[roles]
tracked = ["shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]

[[keys]]
joint = "waist"
times = [0, 1, 2, 3, 4]
values = [0, 40, -40, 20, 0]
curve = "auto"        # step, linear, auto (no overshoot), natural, clamped; or ease = "smooth"

[[keys]]
joint = "shoulder"
times = [0, 1.5, 4]
values = [20, 45, 20]

[[keys]]
joint = "elbow"
times = [0, 1, 1.5, 2, 2.5, 4]
values = [-60, -90, -60, -90, -60, -60]

# Joints without keys are solved for goals, before the run or live ('pantograph plan' tells which).
# [[goals]]
# at = "tip"          # a site, or "body:NAME"
# times = [0, 4]
# position = [[0.4, 0, 0.4], [0.4, 0.2, 0.4]]
# kind = "pose"       # point_on_line, point_on_plane, distance, center_of_mass, joint_value, posture, mirror,
#                     # pole, spread, or lock: at = "left_foot", stances = [[0.2, 0.6]] holds a foot still
# weight = 0.1        # a wish; without it, a hard goal

# A loose thing.
[[props]]
name = "ball"
shape = "sphere"
size = [0.05]
position = [0.6, 0.3, 0.8]
color = [0.9, 0.35, 0.2]

[controller]
law = "pd"            # PD along the keys with gravity compensation
period = 0.002        # seconds between its samples
frequency = 6         # Hz, its bandwidth

# [physics]
# contacts = "none"   # "model" (default), "none", or pairs: [["ball", "floor"]]
# limits = true
# friction = true
# gravity = true      # or a vector in m/s^2

# [[forces]]
# body = "ball"
# force = [0, 0, 2]   # newtons
# start = 1.0
# stop = 1.5

[[cameras]]
name = "side"
position = [1.6, -1.6, 1.0]
target = [0, 0, 0.4]

[film]
width = 640
height = 480
fps = 30
camera = "side"
"""
