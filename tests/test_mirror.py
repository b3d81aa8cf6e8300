"""Tests mirror the package: `src/dwell/A/B.py` is tested by `tests/A/test_B.py`."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "src" / "dwell"

#: Modules without a test file of their name, by package: nothing runs them but what is tested
#: through the module that uses them, or they only declare. The list may only become shorter.
WITHOUT = {
    "calibration": """
        error_origin machine_conditions
    """,
    "cellfile": """
        assembly columns entries structure study_entries trace_files
    """,
    "cli": """
        campaign check check_node demo examples exit_codes live_view run schema
    """,
    ".": """
        errors
    """,
    "estimators": """
        evidence protocol
    """,
    "kernels": """
        advance cache_name cycles layout links nodes
    """,
    "live": """
        agent cycle_ledger failures log node operator_client permissions role role_process
        run_rows stamper
    """,
    "live/transport": """
        expressions
    """,
    "live/trust": """
        authority roster
    """,
    "model": """
        fabric instants pipeline user_classes
    """,
    "policies": """
        protocol
    """,
    "report": """
        answer charts policy_blocks run_header timeline topology
    """,
    "sim": """
        arrays tables
    """,
    "study": """
        campaign_questions drawn_disturbances job_times judged_prediction judging
        measured_run parts player predicting qos_sample saved software validated_jobs
    """,
    "testbed": """
        cell_observer cgroups child draws event_loop forwarder loopback measured
        message_costs node_loads orders realtime remote sampling task_costs testbed
        trace_names watcher
    """,
    "testbed/chaos": """
        actuator_observer faults harness light_cell stages strike wiretap
    """,
}


def modules() -> set[str]:
    """Return modules as paths below the package."""
    found = (path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))
    return {str(path.with_suffix("")) for path in found if not path.stem.startswith("__")}


def test_every_module_has_a_test_file_of_its_name_but_for_those_listed() -> None:
    listed = {f"{package}/{name}" for package, names in WITHOUT.items() for name in names.split()}
    listed = {name.removeprefix("./") for name in listed}
    without = {
        name
        for name in modules()
        if not (TESTS / name).with_name(f"test_{Path(name).name}.py").is_file()
    }
    assert without == listed
