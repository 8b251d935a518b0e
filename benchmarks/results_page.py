"""Writes docs/results.md, and the tables in the README, from stored results: no number is typed.

    python benchmarks/results_page.py

In the README, what stands between `<!-- results: NAME -->` and `<!-- end -->` is replaced.
"""

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

import tyro

from comparison import claims
from comparison.files import write_whole
from comparison.judging import Evaluated
from comparison.markdown import markdown
from comparison.reruns import marks
from comparison.study import Study, read
from comparison.tables import (
    efficiency_table,
    footnotes,
    success_row,
    success_tables,
    table_1,
    throughput_table,
)

HERE = Path(__file__).parent
STUDY = "paper-cartpole-20"
QUICKSTART = "quickstart"  # where `examples/quickstart.py --picture` was told to draw
ROBOTS = {
    "paper-push": ("anymal_push", "ANYmal-Push"),
    "paper-climb": ("anymal_climb", "ANYmal-Climb"),
    "paper-repose": ("trifinger_repose", "Trifinger-Repose: place"),
    "paper-repose-yaw": ("repose_yaw:make_env", "Trifinger-Repose: place and heading"),
}
"""Studies of robots, their tasks and titles; those that have no results yet are left out."""
_FALLS_ALONE = """In the oldest seeds the training returns of the first seven seconds of the second stage
    were those of episodes that had fallen, and are left out (`benchmarks/comparison/corrections.py`)."""
_SAME_BEGINNING = """The first stage of every run is that of the same method and seed of paper-repose,
    copied: the settings are the same."""
SINCE_THEN = """Since these runs, all methods have been tuned anew. Plain PPO takes the detour less often
    now; its sides stay farther apart than with symmetric copies:
    [ten seeds on which nothing was chosen](docs/results.md#ten-seeds-on-which-nothing-was-chosen)."""
EARLIER_SEARCH = """The stored runs used the winners of an earlier search, with the learning rate adapted
    one minibatch late; they await a rerun with these. What changes most is plain PPO, which had been given
    too few and too late updates: see the ten seeds below."""
WAITING = """Rows with a mark in the tables were trained by a rule that has changed since, and await a
    rerun; verdicts and figures are those of the stored runs. A row without one, though trained before, had
    by chance what the rules prescribe now: a deviation that was frozen at its cap in the last stage is that
    of the schedule."""
"""What marks mean for the rest of a section."""
REMARKS = {
    "paper-push": _FALLS_ALONE,
    "paper-climb": _FALLS_ALONE,
    "paper-repose-yaw": _SAME_BEGINNING,
}
"""What else has to be known of a study."""
README_METHODS = ["ppo", "loss-0.1", "aug-naive", "aug", "aug-random"]
CAPTIONS = {
    "training": "Training return and symmetry loss over environment steps (the paper's training figure).",
    "goals": "Every seed's return from both starting sides: a long line is a policy with a favourite side.",
    "log_prob": "Mean log-probability in the denominator of the update, over augmented samples, a line per "
    "seed: the original rule keeps that of the original sample, the naive rule re-evaluates it on the copy "
    "(the paper's log-probability figure).",
    "initialization": "Initial weights of several scales (the paper's initialisation figure).",
    "efficiency": "Share of seeds that have reached a return, over environment steps and over time.",
}

ROBOT_CAPTIONS = {
    "paths": "The best seed's policy from above: what moves freely (the robot, its object dashed; of the "
    "fingers, the cube), from dots to squares, the targets. Colours are equivalent goals, of several "
    "starts each; on the right all mapped back onto one (the paper's figure of observed trajectories). "
    "Front and left are a walking robot's own, whose heading at the start is random.",
    "touches": "The best seed's policy: share of the time in contact with the cube that each limb has a "
    "part in, goal by goal.",
    "heights": "The best seed's policy: success over the height of the box, facing it.",
    "frames": "Key frames of two equivalent goals, the best seed's policy of each method.",
    "training": "Training return and symmetry loss; in curves, here and below, methods that one seed tried "
    "are left out.",
    "success": "Success in training, an average that begins at zero in every phase of a curriculum, and "
    "the level. Who passes the last level goes on at any, so with success everywhere the mean level is "
    "about two thirds of the last; at the end of Climb and Repose all are at the last.",
    "phases": "Every seed's training return through the phases of the curriculum; a tick where it enters "
    "the next, a line where the median seed does: B, no longer paid for walking; C, starting with any "
    "heading. The dip at the end is the second stage: the highest box alone.",
    "goals": "Success of every seed on every equivalent goal, in the first evaluation above, also of "
    "methods that one seed tried.",
    "efficiency": "Share of seeds that have come so far, over environment steps and over time.",
}


@dataclass
class Arguments:
    """Write the page of results and the tables of the README."""

    results: Path = HERE / "results"
    """Where results are stored."""
    docs: Path = HERE.parent / "docs"
    """Where results.md goes."""
    readme: Path = HERE.parent / "README.md"
    """The README."""


def page(study: Study, tuning: str, quickstart: str, robots: dict[str, Study]) -> str:
    """docs/results.md: claims, Table I, figures, efficiency, tuning, fresh seeds; then the robots."""
    about, task = study.about, study["cartpole"]
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    figures = "\n".join(
        f"![{name}](../benchmarks/plots/{STUDY}/{name}.png)\n\n{prose(f'*{caption}*')}\n"
        for name, caption in CAPTIONS.items()
    )
    made = prose(f"""Made by `python benchmarks/results_page.py` from
        [benchmarks/results](../benchmarks/results); a test compares. The runs: `{command(STUDY)}` at
        {", ".join(about["revisions"])} (+: with changes on top; {versions}; {about["machine"]},
        {about["workers"]} runs at a time, threads each: {about.get("threads", 1)}; {study.trained}
        runs, {study.hours:.1f} hours of one core in training; which run is of which commit is in
        `runs.csv`). Draw again: `python benchmarks/plot.py {STUDY}`.""")
    rule = prose("""Two methods are compared by the difference of their interquartile means
        over seeds, with its 95 % bootstrap interval in brackets. *Confirmed*: the interval lies on the
        side that the paper claims. *Different*: on the other side. *Not confirmed*: it contains zero.
        That something gains nothing is confirmed if the whole interval lies below a margin. Counts of
        seeds are compared by Fisher's exact test, 2.5 % on either side. The paper's returns are not
        comparable in size: it gives neither velocity limit nor episode length.""")
    outdated = any(map(marks, task.values()))
    if outdated:
        rule += "\n\n" + prose(WAITING)
    tuned = """Every family of methods tried the same changes of the same settings with
        the same seeds, which are not those above; the winner of a family is used for all its methods
        (`tuned` in `tasks/settings.py`). So the claims compare methods at their own best; a row of this
        table compares them at equal settings. The weight of the mirror loss was varied in addition. The
        shape of the batch was chosen before, for plain PPO and augmentation together."""
    if outdated:
        tuned += " " + EARLIER_SEARCH
    tuned = prose(tuned)
    naive = prose("""Naive augmentation is run with three protections: its log-ratio is clamped at 20, its
        standard deviation at 10, and its learning rate adapts to the KL over samples and copies, so that
        it falls when the ratios of the copies explode. The last one alone keeps it finite: the other two
        are then never reached. *Unprotected* has none of them, and the learning rate that augmentation
        learns with (1e-2, the cap).""")
    return f"""# Results

{made}

## The paper's claims on CartPole

{rule}

{claims.table(task)}
## Table I

{table_1(task)}
## Figures

Lines are interquartile means over seeds, bands their 95 % bootstrap intervals.

{figures}
## Naive augmentation, protected and not

{naive}

## Efficiency

{efficiency_table(task)}
## How the methods were tuned

{tuned}

{tuning}
## Ten seeds on which nothing was chosen

{quickstart}
{"".join(robot_section(name, each) for name, each in robots.items())}"""


def fresh_seeds(table: str) -> str:
    """What quickstart showed with seeds that neither the search nor the comparison had used."""
    picture = f"![learning curves](../benchmarks/plots/{QUICKSTART}/learning_curves.png)"
    about = prose("""Plain PPO and augmentation with these settings and the corrected order of the learning
        rate, with seeds that neither the search nor anything else had seen. What is promised of
        augmentation: its worst seed better than -1.6, its sides apart by less than 0.05. Well tuned, plain
        PPO takes the detour that the runs above show less often; but its sides stay farther apart than with
        symmetric copies, and its policy far less symmetric on the states that it visits.""")
    return f"{about}\n\n{table}\n{picture}\n"


def robot_section(name: str, study: Study) -> str:
    """What the paper claims of a robot task and what was found, with figures and costs."""
    (of, title), about = ROBOTS[name], study.about
    task = study[of]
    made = prose(f"""`{command(name)}` at {", ".join(about["revisions"])}: {study.trained} runs of
        {study.million_steps:.1f} million steps, {study.hours:.1f} hours of one core;
        {about["machine"]}. Draw again: `python benchmarks/plot.py {name}` and
        `python benchmarks/behaviour.py {name}`. The settings were found with augmentation and are used for
        all methods; none was tuned by itself.""")
    losses = Evaluated(task).losses
    if losses(1):
        close = len(losses()) > 1
        made += "\n\n" + prose(f"""Of the weights of the mirror loss, the one whose first seed had the
            highest return with mean actions, in the mean of all evaluations, got all
            seeds{", and so did one that came close" * close}.""")
    if about.get("unfinished"):
        made += "\n\n" + prose(f"""**Still in progress**: {len(about["unfinished"])} runs of this comparison
            have not been made yet. The same command makes them.""")
    made += "\n\n" + prose("""Verdicts on fewer than five seeds say so: with three, where two methods do not
        differ, one in ten is *confirmed* by chance, with five one in thirty; a single seed has no interval
        and decides nothing. Seconds are those of runs at different times, on a machine whose speed is not
        always the same: steps compare methods, seconds say how long to wait.""")
    if any(map(marks, task.values())):
        made += "\n\n" + prose(WAITING)
    if name in REMARKS:
        made += "\n\n" + prose(REMARKS[name])
    judged = "\n".join(
        (f"### Claims: {what}\n\n" if what != "task" else "") + claims.table(task, what)
        for what in task.evaluations
    )
    return f"""
## {title}

{made}

{judged}
{success_tables(task)}
{robot_figures(name)}
{efficiency_table(task)}
{throughput_table(task) if task.has_split else ""}"""


def command(name: str) -> str:
    """What makes the results of a preset anew; `study.json` has what was given to make these."""
    return f"python benchmarks/compare.py --preset {name}"


def robot_figures(name: str) -> str:
    """The pictures of a robot study that have been drawn, each with what it shows, and its films."""
    folder = HERE / "plots" / name
    drawn = sorted(path.name for path in folder.glob("*.png"))
    text = "\n".join(
        f"![{kind}](../benchmarks/plots/{name}/{file})\n\n{prose(f'*{caption}*')}\n"
        for kind, caption in ROBOT_CAPTIONS.items()
        for file in drawn
        if file.removesuffix(".png").endswith(kind)
    )
    films = sorted(path.name for path in folder.glob("*.mp4"))
    films = [f"[{file}](../benchmarks/plots/{name}/{file})" for file in films]
    return text + (f"\nFilms of the same policies (`make films`): {', '.join(films)}.\n" if films else "")


def readme_block(study: Study) -> str:
    """The README's table, and what it shows."""
    shown = [study["cartpole"][name] for name in README_METHODS]
    plain, copies = (study["cartpole"][name].variation() for name in ("ppo", "aug"))
    one_sided = f"{(plain > claims.SWING).sum()} of {len(plain)}"
    seeds = " to ".join(map(str, sorted({len(results.seeds) for results in shown})))
    text = prose(f"""The two sides differ by more than {claims.SWING:g} in {one_sided} seeds of
        plain PPO: from one of them it swings the pole up by a detour. With symmetric copies the worst of
        {len(copies)} seeds differs by {copies.max():.3f}. Every claim of
        the paper with evidence and verdict, also those that do not hold here:
        [results](docs/results.md).""")
    if any(map(marks, shown)):
        text += "\n" + prose(SINCE_THEN)
    head = f"After {study.million_steps:.1f} million steps, {seeds} seeds per method:"
    return f"{head}\n\n{table_1(study['cartpole'], README_METHODS)}\n{text}\n"


def readme_robot_block(studies: dict[str, Study]) -> str:
    """What the README says of the robots: plain PPO and augmentation on every task."""
    columns = ("seeds", "success [%]", "worst goal [%]", "spread [%]")
    rows = []
    for name, study in studies.items():
        of, title = ROBOTS[name]
        task = study[of]
        what = task.evaluations[0]
        first = f"{title}{f', {what}' * (what != 'task')}, {study.million_steps:.1f} M steps"
        for results in (task["ppo"], *Evaluated(task).losses(), task["aug"]):
            row = success_row(results)
            rows.append([first, row["method"], *(row.get(column, "-") for column in columns)])
            first = ""
    episodes = max(max(study.about["episodes"]) for study in studies.values())
    text = prose(f"""Success in {episodes} episodes of every equivalent goal, mean actions: interquartile
        means over seeds with 95 % bootstrap intervals (of three seeds: mean, lowest, highest). *worst
        goal*: of the equivalent ones, seed by seed. *spread*: the largest difference between two of them,
        in percentage points.""")
    missing = sum(len(study.about.get("unfinished", [])) for study in studies.values())
    if missing:
        text += "\n" + prose(f"More seeds and methods are being trained: {missing} runs.")
    return f"{markdown(['task', 'method', *columns], rows, texts=2)}{footnotes(rows)}\n{text}\n"


def prose(text: str) -> str:
    """A paragraph in lines of the repository's width."""
    return textwrap.fill(" ".join(text.split()), 108, break_long_words=False, break_on_hyphens=False)


def replace_blocks(text: str, blocks: dict[str, str]) -> str:
    """A text with the content of its marked blocks replaced.

    Raises:
        ValueError: a block is not there.
    """
    for name, content in blocks.items():
        pattern = re.compile(rf"(<!-- results: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(text):
            raise ValueError(f"expected a block '<!-- results: {name} -->' ... '<!-- end -->', found none")
        text = pattern.sub(lambda match, content=content: match[1] + content + match[2], text)
    return text


def main(arguments: Arguments) -> None:
    study = read(arguments.results / STUDY)
    tuning = (arguments.results / "tuning" / "README.md").read_text()
    quickstart = (HERE / "plots" / QUICKSTART / "learning_curves.md").read_text()
    robots = {n: read(arguments.results / n) for n in ROBOTS if (arguments.results / n).exists()}
    write_whole(arguments.docs / "results.md", page(study, tuning, fresh_seeds(quickstart), robots))
    blocks = {"cartpole": readme_block(study)}
    if robots:
        blocks["robots"] = readme_robot_block(robots)
    text = replace_blocks(arguments.readme.read_text(), blocks)
    write_whole(arguments.readme, text)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
