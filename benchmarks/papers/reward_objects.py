"""Split of the catalogue for rewards: objects that units and values learn from, and the others.

Each shape has two objects on either side, so that an object of the same shape and another material
is at hand on both.
"""

TRAINING_OBJECTS = (
    "glass_ball",
    "yarn_ball",
    "wooden_block",
    "cushion",
    "soda_can",
    "rope_coil",
    "candle",
    "corn_cob",
    "pebble",
    "rag_bundle",
)
"""Objects of successes that normalizers and values are fitted on; choices are made on these, too."""

HELD_OUT_OBJECTS = (
    "golf_ball",
    "foam_ball",
    "brick",
    "toy_brick",
    "bottle_cap",
    "cork",
    "sausage",
    "brush_handle",
    "walnut",
    "clay_lump",
)
"""Objects held out from every fit of units and values: `benchmark reward-quality` judges on these."""
