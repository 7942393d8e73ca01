"""Model card of an encoder or a policy, from the provenance beside its weights."""

import json
from typing import Any

CARD = "README.md"
_TITLES = {"encoder": "Touch encoder", "policy": "Policy"}
_PIPELINES = {"encoder": "image-feature-extraction", "policy": "robotics"}  # the Hub's names
_USES = {
    "encoder": "touchgoal reward-curves VIDEO --encoder {repository}",
    "policy": "touchgoal run-policy --task {task} --policy {repository}",
}


def model_card(kind: str, description: dict[str, Any], repository: str) -> str:
    """Return the card of `repository` (owner/name) as Markdown with the Hub's front matter.

    `description` is the JSON beside the weights: format, config and provenance.
    """
    config, provenance = description["config"], description["provenance"]
    use = _USES[kind].format(repository=repository, task=config.get("task"))
    return f"""---
library_name: touchgoal
pipeline_tag: {_PIPELINES[kind]}
tags: [touchgoal, tactile]
---

# {repository.rpartition("/")[2]}

{_TITLES[kind]} for the tactile sensor `{config.get("sensor")}`, trained with touchgoal
{provenance.get("touchgoal", "")}. Weights are safetensors; nothing in this repository is code.

```
touchgoal pull {repository}
{use}
```

## Provenance

```json
{json.dumps(provenance, indent=2)}
```

## Configuration

```json
{json.dumps(config, indent=2)}
```
"""
