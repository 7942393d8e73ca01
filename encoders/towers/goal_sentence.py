"""Goal sentences that a text encoder misreads: negated ones, and ones that contradict themselves."""

import re

from touchgoal.runtime.errors import UserError

_NEGATION = re.compile(
    r"\b(?:no|not|non|never|none|nothing|neither|nor|without|hardly|barely|cannot|lacks?|lacking"
    r"|\w+n['’]t)\b"
)
_OPPOSITES = (
    ({"soft", "squishy", "spongy", "mushy"}, {"hard", "rigid", "stiff"}),
    ({"smooth", "slick", "sleek"}, {"rough", "coarse", "bumpy", "uneven"}),
)


def check_goal_sentence(sentence: str) -> None:
    """Raise UserError if a sentence negates something, or names a property and its opposite.

    To a text encoder "not soft" is close to "soft", and "hard and soft" lies between the two.
    """
    lower = sentence.lower()
    if negation := _NEGATION.search(lower):
        raise UserError(
            f"goal sentence '{sentence}': the text encoder hardly notices '{negation[0]}'; say what "
            "is there instead, such as 'smooth' for 'not rough'"
        )
    words = set(re.findall(r"\w+", lower))
    for one, other in _OPPOSITES:
        if (first := words & one) and (second := words & other):
            raise UserError(
                f"goal sentence '{sentence}' says both '{min(first)}' and '{min(second)}'; describe "
                "only what the fingertips should touch"
            )
