"""The report of a campaign: what was measured, what it answers, and what can be shown by so few."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dwell.report import campaign_figures as shown
from dwell.report import chapter_tables, figures
from dwell.report.answers import answers, beginning
from dwell.report.contenders import describe_contenders, palette_of
from dwell.report.drawing import draw
from dwell.report.formatting import listed, percent, shown_contender, shown_scenario, write_number
from dwell.report.method import describe_cell, describe_scenario
from dwell.report.page import (
    definitions,
    document,
    figure,
    items,
    paragraph,
    section,
)
from dwell.report.style import PageStyle
from dwell.report.svg import inline
from dwell.study.campaign_questions import is_steady, main_table, needed_pairs, questions
from dwell.study.chapter import Chapter, Figure
from dwell.study.measured_campaign import MeasuredCampaign

__all__ = ["campaign_html", "counted_windows", "limits_of"]

TITLE = "A campaign of measurements"
#: Runs that were simulated in the place of measured ones.
SIMULATED = "Some of these runs, or all, were simulated in place of measurements."


def campaign_html(measured: MeasuredCampaign) -> str:
    """Return a self-contained page about a campaign, finished or not.

    Parameters
    ----------
    measured : MeasuredCampaign

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.
    """
    comparison = measured.comparison
    chapters = questions(measured)
    look = PageStyle(
        palette_of(comparison.problem, comparison.policies), frozenset(comparison.scenarios)
    )
    body = [f"<h1>{TITLE}</h1>", paragraph(_subtitle(measured), "subtitle")]
    if measured.kinds != {"live"}:
        body.append(paragraph(SIMULATED, "bad"))
    body += answers(chapters, look)
    body.append(items(_told(measured, chapters)))
    body.append(section("Results", *_results(measured, look)))
    body.append(section("Distributions", *_distributions(measured, look)))
    for chapter in chapters:
        body.append(_chapter(chapter, look))
    body.append(section("What jobs and messages took", *_parts(measured, look)))
    body.append(section("What was run when", *_record(measured, look)))
    body.append(section("How it was measured", *_method(measured)))
    body.append(section("What it does not say", items(limits_of(measured))))
    return document(TITLE, body)


def _subtitle(measured: MeasuredCampaign) -> str:
    comparison = measured.comparison
    where = "on the testbed" if measured.where == "testbed" else "on real hosts"
    return (
        f"Cell “{comparison.problem.name}” {where}: {len(comparison.scenarios)} scenarios × "
        f"{len(comparison.policies)} policies, {measured.log.height} of {measured.planned} runs of "
        f"{write_number(measured.seconds, 0)} s, {measured.repetitions} complete "
        f"{'repetition' if measured.repetitions == 1 else 'repetitions'}"
    )


def _told(measured: MeasuredCampaign, chapters: Sequence[Chapter]) -> Iterator[str]:
    yield _power(measured, chapters)
    yield counted_windows(measured)


def _power(measured: MeasuredCampaign, chapters: Sequence[Chapter]) -> str:
    """Say what can be shown with so few repetitions."""
    count = len(measured.comparison.seeds)
    text = (
        f"The unit is the repetition, of which there {'is' if count == 1 else 'are'} {count}: "
        f"a single difference takes {needed_pairs(1)} before a sign-flip test can show it at 5 %"
    )
    families = sorted({len(_comparisons(one)) for one in chapters})
    if families:
        needed = [f"a family of {size} takes {needed_pairs(size)}" for size in families]
        text += f"; {listed(needed)}"
    rest = "What is not shown is not excluded either: the intervals say what is left open."
    if count == 1:
        rest = "One repetition has no interval, and nothing is tested."
    return f"{text}. {rest}"


def _comparisons(chapter: Chapter) -> Sequence[object]:
    return chapter.tables[-1].frame.rows()


def counted_windows(measured: MeasuredCampaign) -> str:
    """Say how many windows were excluded, and how many attempts failed."""
    windows, excluded = (int(measured.log[name].sum()) for name in ("windows", "excluded"))
    touched = int((measured.log["excluded"] > 0).sum())
    text = (
        f"{excluded} of {windows} windows after the warm-up were measured under pressure and are "
        f"excluded ({percent(excluded / windows, 1)})"
    )
    text += f", in {touched} of {measured.log.height} runs. " if excluded else ". "
    if measured.failed.height:
        outcomes = dict(measured.failed["outcome"].value_counts().sort("outcome").rows())
        words = {"error": "ended with an error", "failed": "were under pressure for too long"}
        each = [f"{count} {words.get(name, name)}" for name, count in outcomes.items()]
        text += f"Attempts that failed, and count nowhere: {listed(each)}."
    else:
        text += "No attempt failed."
    return text


# ----------------------------------------------------------------------------------- parts


def _results(measured: MeasuredCampaign, look: PageStyle) -> Iterator[str]:
    comparison = measured.comparison
    yield definitions(describe_contenders(comparison.problem, comparison.policies))
    yield paragraph(
        "V_D is the share of cycles that finished after the deadline or not at all; L95 the 95th "
        "percentile of a window's latencies, averaged over the windows; U_r and U_e the "
        "utilisation of the busiest robot and edge node; J the cost that weighs all of these."
    )
    main = main_table(comparison.runs, "main", "Every policy in every scenario")
    yield chapter_tables.html(main, look, main=True)
    for measure in shown.MEASURES:
        yield _drawn(shown.measures_figure(measured, measure), look, _caption(measure))
    moving = [name for name in comparison.policies if name not in comparison.statics]
    if moving and _is_complete(measured):
        yield figure(
            figures.placement_shares(comparison, look.palette, moving),
            "Where the policies that move spent their windows.",
        )


def _is_complete(measured: MeasuredCampaign) -> bool:
    """Whether every policy has a run in every scenario."""
    comparison = measured.comparison
    pairs = comparison.runs.select("scenario", "policy").unique().height
    return pairs == len(comparison.scenarios) * len(comparison.policies)


def _caption(measure: str) -> str:
    text = {
        "violation_rate": "V_D, the share of missed deadlines",
        "l95_ms": "Tail latency as the controller sees it",
        "u_robot": "Utilisation of the busiest robot",
        "u_edge": "Utilisation of the busiest edge node",
    }[measure]
    return f"{text}: mean over repetitions, with its 95 % interval as a bar where there is one."


def _distributions(measured: MeasuredCampaign, look: PageStyle) -> Iterator[str]:
    yield _drawn(
        figures.latency_figure(measured.comparison),
        look,
        "Latency of all cycles after the warm-up, all repetitions together: one less the empirical "
        "distribution function, on a logarithmic scale. Where a curve crosses the dashed line one "
        "reads V_D. A curve that ends on a plateau lost that share of its cycles.",
    )
    yield paragraph(
        "The same of windows: of what share of them the measure is at or below a value. All "
        "repetitions together; windows of a run are not independent."
    )
    for one in shown.window_figures(measured):
        yield _drawn(one, look, f"{one.title}.")


def _chapter(chapter: Chapter, look: PageStyle) -> str:
    parts = [
        beginning(chapter, look),
        paragraph(look.prose(chapter.verdict), "question"),
        items(map(look.prose, chapter.evidence), "evidence"),
        paragraph(look.prose(chapter.design), "note"),
    ]
    parts += [_drawn(one, look, chapter_tables.noted(one, look)) for one in chapter.figures]
    for item in chapter.tables:
        parts.append(chapter_tables.html(item, look, main=item.slug == chapter.slug))
    parts += ["<h3>What else came out</h3>", items(map(look.prose, chapter.findings))]
    return "\n".join([*parts, "</section>"])


def _parts(measured: MeasuredCampaign, look: PageStyle) -> Iterator[str]:
    if measured.profiles.is_empty() and measured.links.is_empty():
        yield paragraph("The runs kept no jobs: there is nothing to take profiles from.")
        return
    if not measured.profiles.is_empty():
        one = shown.profiles_figure(measured)
        yield _drawn(one, look, one.note)
        yield chapter_tables.html(shown.profiles_table(measured), look)
    if not measured.links.is_empty():
        one = shown.delays_figure(measured)
        yield _drawn(one, look, one.note)
        yield chapter_tables.html(shown.links_table(measured), look)


def _record(measured: MeasuredCampaign, look: PageStyle) -> Iterator[str]:
    busy = measured.log.height - int(measured.log["idle"].sum())
    yield paragraph(
        "Each repetition is a complete random order of all policies in all scenarios. Before a run "
        "begins the machine has to be idle for some seconds; "
        + (
            f"{busy} of {measured.log.height} runs began although it was not, patience being over."
            if busy
            else "it was before every run."
        )
    )
    yield chapter_tables.html(shown.log_table(measured), look)
    if measured.failed.height:
        yield chapter_tables.html(shown.failed_table(measured), look)


def _method(measured: MeasuredCampaign) -> Iterator[str]:
    comparison = measured.comparison
    problem = comparison.problem
    yield paragraph(
        "Real processes run the pipeline on hosts of their own; disturbances are played on their "
        "links and CPUs. All policies of a scenario and repetition have the same seed and follow "
        "each other in random order, so that differences are taken repetition by repetition."
    )
    beliefs = [
        f"{shown_contender(name)}: `{estimator}`"
        for name, estimator in measured.estimators.items()
        if name not in problem.candidates
    ]
    yield definitions(
        {
            **describe_cell(problem),
            "estimators": listed(beliefs) or "none",
            "run": f"{write_number(measured.seconds, 0)} s, of which the first "
            f"{problem.warmup_windows} windows are warm-up and count nowhere",
            "intervals": "95 %, two-sided, over repetitions, by the studentised bootstrap from 4 "
            "on, by Student's t below; none is taken over windows or cycles, which are not "
            "independent",
            "versions": ", ".join(f"{name} {text}" for name, text in comparison.versions.items()),
        }
    )
    yield paragraph("What the scenarios add to the cell:")
    yield items(
        f"{shown_scenario(name)}: {describe_scenario(problem.scenario(name))}."
        for name in comparison.scenarios
    )


def limits_of(measured: MeasuredCampaign) -> Iterator[str]:
    """Yield what the numbers do not say."""
    yield (
        "One machine, or one set of hosts, at one time: intervals are over repetitions there, and "
        "say nothing of other hardware."
    )
    if measured.where == "testbed":
        yield (
            "Hosts are namespaces with quotas of one machine's cores: they share its caches, its "
            "memory and its kernel."
        )
    comparison = measured.comparison
    if is_steady(comparison.problem, comparison.scenarios):
        yield (
            "Scenarios are steady from the first cycle to the last: how fast a policy reacts to a "
            "change shows in the warm-up only, which does not count."
        )
    if any(name.partition("+")[0] == "atp" for name in comparison.policies):
        yield ("ATP is our reconstruction: its authors' may do better or worse.")


def _drawn(item: Figure, look: PageStyle, caption: str) -> str:
    return figure(inline(draw(item, look), item.slug, item.title), caption)
