"""A small robot: two joints that turn and one that slides, as a device declaration."""

ARM = {
    "name": "arm",
    "coordinates": {
        "one": {"kind": "rotary"}, "two": {"kind": "rotary"}, "rail": {"kind": "linear"}
    },
    "robot": {
        "joints": {
            "one": {"kind": "revolute", "mass": 2.0, "center": [0.2, 0.0, 0.1],
                    "inertia": [0.02, 0.001, 0.0, 0.05, 0.0, 0.05]},
            "two": {"kind": "revolute", "after": "one", "position": [0.5, 0.0, 0.0],
                    "rotation": [1.2, 0.0, 0.3], "axis": [0.0, 1.0, 0.0], "mass": 1.0,
                    "center": [0.0, 0.1, 0.2], "inertia": [0.01, 0.0, 0.0, 0.02, 0.0, 0.02]},
            "rail": {"kind": "prismatic", "after": "two", "position": [0.0, 0.2, 0.0],
                     "mass": 0.5, "center": [0.0, 0.0, 0.1]},
        }
    },
    "inputs": {"force": ["a", "b", "c"], "force_unit": "N.m", "drive": True},
    "applied": {"one": "a", "two": "b", "rail": "c"},
    "friction": {
        name: {"viscous": {"unit": "", "prior": 0.3, "sd": 1.0},
               "coulomb": {"unit": "", "prior": 0.2, "sd": 1.0}}
        for name in ("one", "two", "rail")
    },
}  # fmt: skip
