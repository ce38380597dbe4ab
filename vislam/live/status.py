"""The state of a live run in one line."""

from vislam.hw.health import Health
from vislam.live.run_live import LiveRun


def status_line(run: LiveRun) -> str:
    """Return where the cart is, how sure that is, what is wrong with the sensors, and how late poses are."""
    if not run.is_going:
        return f"getting ready: {_getting_ready(run)}"
    if run.is_brief:
        return "ending at once: the map's files and the report are left for later"
    if run.is_ending:
        return "ending: the run is written down; Ctrl-C again does not wait for that"
    fast = run.notes.get("fast", {})
    status, latency = fast.get("status"), fast.get("latency_ms", {})
    if not status:
        return "no pose yet"
    x, y, z = status["position_m"]
    health = Health(status["health"])
    names = " ".join((flag.name or "").lower() for flag in health) or "not levelled"
    refused = fast.get("power_up", {}).get("refused")
    names += "  found in the map" if run.notes.get("map", {}).get("found_in_map") else ""
    reasons = run.notes.get("front", {}).get("verdict", {}).get("reasons")
    names += f"  because {reasons[0]}" if reasons else ""
    names += f"  no zero yet: {refused}" if refused else ""
    silent = {name: word for name, word in run.notes.get("front", {}).get("sensors", {}).items() if word != "well"}
    names += "".join(f"  {name} {word}" for name, word in silent.items())
    late = f"{latency['p50']:.2f}/{latency['p99']:.2f} ms" if "p50" in latency else "-"
    every = run.notes.get("front", {}).get("every", 1)
    slow = f"too slow, one frame in {every} is taken  " if every > 1 else ""
    left_out = run.notes.get("map", {}).get("map_left_out", 0)
    slow += f"map too slow, {left_out} keyframes left out  " if left_out else ""
    return (
        f"{slow}x {x:7.2f} y {y:7.2f} z {z:5.2f} m +-{status['sigma_m']:.2f}  {status['speed_m_s']:.2f} m/s  "
        f"map {status['map_revision']}  sample to pose {late} (p50/p99)  {names}"
    )


def _getting_ready(run: LiveRun) -> str:
    """Return what is waited for, and how long that may take."""
    waiting = ", ".join(run.waits_for) or "nothing"
    compiled = sum(notes.get("compiled", 0) for notes in run.notes.values())
    if not compiled:
        return f"loading {waiting}: under a minute unless the machine is busy"
    so_far = f"{compiled} functions so far, 5 minutes or so where none was compiled yet"
    return f"compiling, once for this machine: {so_far}; waiting for {waiting}"
