"""Pages of the manual that are made from the code: one for each track, the rewards, the policies, the reference.

A hook of MkDocs, and an extension of Griffe, which reads the docstrings for the reference.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import re
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from agents import POLICIES
from agents.leaderboard import leaderboard_file, leaderboard_tables
from agents.policies import TRAINED, trained_policies
from duffing_env import TRACKS
from duffing_env.rewards import named_rewards

#: A file of the repository that pages link to, to the page that is made of it.
MADE_OF = {
    "duffing_env/tracks/track_registry.py": "tracks/index.md",
    "duffing_env/rewards/named_rewards.py": "rewards.md",
    "agents/policies/__init__.py": "reference/policies.md",
    "agents/leaderboard.jsonl": "leaderboard.md",
}

#: Page of the reference to the objects that stand on it.
REFERENCE = {
    "estimator": [f"estimator.{name}" for name in importlib.import_module("estimator").__all__],
    "duffing_env": [
        "duffing_env.vector_env.DuffingVectorEnv",
        "duffing_env.tracks.silverbox_replay.SilverboxReplayVectorEnv",
        "duffing_env.env_common.ExperimentEnv",
        "duffing_env.belief_arrays.Beliefs",
        "duffing_env.tracks.external_plant_env.Plant",
        "duffing_env.plants.silverbox_record.load_record",
        "duffing_env.plants.silverbox_record.regime_input",
    ],
    "agents": [
        "agents.training.TrainConfig",
        "agents.training.train",
        "agents.training.resume",
        "agents.training.multi_seed_training",
        "agents.training.tune_hyperparameters",
        "agents.training.PPOSettings",
        "agents.training.SACSettings",
        "agents.training.TD3Settings",
        "agents.training.TQCSettings",
        "agents.training.RecurrentPPOSettings",
        "agents.training.environments.feature_vec_env.FeatureVecEnv",
        "agents.evaluation.policy_evaluation",
        "agents.sb3_vec_env",
    ],
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the tracks into the menu."""
    environments = next(entry["Environments"] for entry in config.nav if "Environments" in entry)
    tracks = next(entry["Tracks"] for entry in environments if "Tracks" in entry)
    tracks += [{_title(track): _page(track)} for track in TRACKS]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    pages = {
        "tracks/index.md": _tracks(),
        **{_page(track): _track(track) for track in TRACKS},
        "rewards.md": f"# Rewards\n\n{_fenced(inspect.getdoc(named_rewards) or '')}",
        "reference/policies.md": _policies(),
        "leaderboard.md": _leaderboard(),
        **{f"reference/{name}.md": _reference(name, objects) for name, objects in REFERENCE.items()},
    }
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Mark sessions as such, and link to the pages that are made here.

    In the repository itself ``python``, and a link to the code that such a page is made of, serve a reader better.
    """
    up = "../" * page.file.src_uri.count("/")
    for source, made in MADE_OF.items():
        markdown = markdown.replace(f"]({up}../{source})", f"]({up}{made})")
    return markdown.replace("```python\n>>>", "```pycon\n>>>")


class MarkdownDocstrings(griffe.Extension):
    """Griffe's part: docstrings as Markdown."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Fence an object's examples; and ``E[γ] [1/V²]`` is no link to a reference."""
        if obj.docstring is not None:
            obj.docstring.value = _fenced(obj.docstring.value).replace("] [", r"] \[")


def _fenced(text: str) -> str:
    """Put examples, from a prompt to the next empty line, between fences."""
    return re.sub(r"^( *)>>> (?:.+\n?)+", lambda found: _fence(found[0], found[1]), text, flags=re.MULTILINE)


def _fence(example: str, indent: str) -> str:
    return f"{indent}```pycon\n{example.rstrip()}\n{indent}```\n"


def _title(track: str) -> str:
    return track.removeprefix("duffing_env/")


def _page(track: str) -> str:
    return f"tracks/{_title(track)}.md"


def _environment(track: str) -> type:
    module, name = TRACKS[track]["entry_point"].split(":")
    environment: type = getattr(importlib.import_module(module), name)
    return environment


def _tracks() -> str:
    rows = [f"| [{_title(track)}]({_title(track)}.md) | {_first_line(_environment(track))} |" for track in TRACKS]
    return "\n".join(
        [
            "# Tracks",
            "",
            'A track is a registered environment with its limits: `gymnasium.make("duffing_env/NAME")`. Its page is '
            "the docstring of its class, which is its specification. A change of any number is a new version.",
            "",
            "| Track | |",
            "|---|---|",
            *rows,
        ]
    )


def _track(track: str) -> str:
    text = _fenced(inspect.getdoc(_environment(track)) or "")
    for other in TRACKS:
        name = _environment(other).__name__
        if other != track:
            text = text.replace(f"`{name}`", f"[`{name}`]({_title(other)}.md)")
    options = ", ".join(f"{name}={value!r}" for name, value in TRACKS[track]["kwargs"].items())
    made = f'`gymnasium.make("{track}")`: class `{_environment(track).__name__}`, `{options}`'
    return f"# {_title(track)}\n\n{made}\n\n{text}"


def _policies() -> str:
    rows = []
    for name, made in POLICIES.items():
        arguments = made.args if isinstance(made, functools.partial) else ()
        function = made.func if isinstance(made, functools.partial) else made
        call = ", ".join(argument for argument in arguments if isinstance(argument, str))
        rows.append(f"| `{name}` | {_first_line(function)}{f' ({call})' if call else ''} |")
    return "\n".join(
        [
            "# Policies by name",
            "",
            "A policy chooses the input. All have `predict` of Stable-Baselines3, and are made by name; "
            "[policies](../policies.md) describes them.",
            "",
            "| Name | |",
            "|---|---|",
            *rows,
            *(f"| `{name}` | {_shipped(name)} |" for name in trained_policies()),
            "| a run folder | A trained policy; see [Training](../training.md). |",
            "",
            *(
                f"::: agents.policies.{name}\n"
                for name in (
                    *("make_policy", "Policy", "signals.SignalPolicy"),
                    *("networks.trained_policy.TrainedPolicy", "networks.rollout_features"),
                    "networks.feature_encoder.FeatureEncoder",
                )
            ),
        ]
    )


def _leaderboard() -> str:
    parts = [
        "# Leaderboard",
        "By the [protocol](protocol.md). `duffing-env report` prints it.",
        leaderboard_tables.LEADERBOARD_CAPTION,
    ]
    for track, rows in leaderboard_tables.leaderboard_rows(
        leaderboard_file.read_entries(leaderboard_file.SHIPPED_LEADERBOARD)
    ).items():
        lines = [
            f"| {' | '.join(row)} |"
            for row in (leaderboard_tables.COLUMN_TITLES, ["---"] * len(leaderboard_tables.COLUMN_TITLES), *rows)
        ]
        parts += [f"## {_title(track)}", "\n".join(lines)]
    return "\n\n".join(parts)


def _shipped(name: str) -> str:
    """What the card of a trained policy says."""
    card = json.loads((TRAINED / name / "policy.json").read_text())
    sight = ", with features" if card.get("network", {}).get("features") else ""
    track = _title(card["config"]["env"])
    return f"{card['algorithm'].upper()} trained on {track}{sight}; see [Training](../training.md)."


def _reference(package: str, objects: list[str]) -> str:
    return f"# {package}\n\n" + "\n".join(f"::: {name}\n" for name in objects)


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").split("\n", 1)[0].replace("|", r"\|").replace(r"\\|", r"\|")
