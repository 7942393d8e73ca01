"""A sentence on the touch of each object, in words that no training saw."""

SENTENCES = {
    "glass_ball": "a hard smooth round object",
    "golf_ball": "a hard ball full of little dents",
    "foam_ball": "a squishy sphere with a coarse surface",
    "yarn_ball": "a ball wrapped in woven thread",
    "wooden_block": "a solid plank with fine grooves",
    "brick": "a gritty hard slab of stone",
    "cushion": "a flat squashy pad of fabric",
    "toy_brick": "a plastic block covered with studs",
    "soda_can": "a slick metal cylinder",
    "bottle_cap": "a round lid with grip ridges around it",
    "rope_coil": "a braided cord wound into a roll",
    "cork": "a slightly grainy stopper",
    "candle": "a long smooth wax stick",
    "corn_cob": "a long cob covered with kernels",
    "sausage": "a long soft tube with smooth skin",
    "brush_handle": "a hard grip with ribs along it",
    "pebble": "an irregular smooth hard stone",
    "walnut": "a wrinkled hard shell",
    "clay_lump": "a lump of smooth soft clay",
    "rag_bundle": "a soft heap of woven cloth",
}
