"""Plans and what they mean run by run."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from vislam.core.errors import UsageError
from vislam.experiment.identity import code_sha256, source_identity
from vislam.experiment.jobs import JITTER, expand, unique, variants
from vislam.experiment.plan import load_plan, plan_from_data
from vislam.experiment.report.exports import runs_csv
from vislam.experiment.trials import estimates, trials
from vislam.runs.sources import is_world, open_source, recorded_path, split_source

FAILED = {"status": "failed", "reason": "lost", "run": {}, "outputs": {}}
REPOSITORY = Path(__file__).resolve().parents[2]

GOOD = """
name = "small"
seeds = [0, 3]
members = 2
config = {"frontend.max_tracks" = 50}

[[sequences]]
name = "laps"
source = "points:laps"
options = {duration_s = 6.0}

[[sequences]]
source = "euroc:$ROOT/drone"
config = {"frontend.mode" = "mono"}

[[estimators]]
name = "loose"
config = {"graph.coupling" = "loose"}

[[estimators]]
name = "tight"
config = {"graph.coupling" = "tight", "frontend.max_tracks" = 70}
outputs = ["graph"]

[[axes]]
name = "delay"
setting = "ekf.vision_delay_s"
values = [0.0, 0.1]
"""


def load(tmp_path, text, **variables):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return load_plan(path, {"ROOT": str(tmp_path), **variables})


def test_a_plan_is_the_product_of_its_parts(tmp_path):
    plan = load(tmp_path, GOOD)
    jobs = expand(plan)
    assert len(jobs) == 2 * 2 * 2 * 2 * 2  # sequences, variants, estimators, seeds, members
    assert len({job.key for job in jobs}) == len({job.label for job in jobs}) == len(jobs)
    assert plan.sequences[1].source == f"euroc:{tmp_path}/drone"
    assert [s.name for s in plan.sequences] == ["laps", "drone"]
    assert {job.source for job in jobs} == {"points:laps,duration_s=6.0", f"euroc:{tmp_path}/drone"}
    assert variants(plan, "laps") == [(("delay", 0.0),), (("delay", 0.1),)]
    assert estimates(plan)[-2:] == [("loose", "graph"), ("tight", "graph")]


def test_an_axis_may_be_for_some_sequences_only(tmp_path):
    more = """
[[axes]]
name = "start [s]"
option = "start_s"
values = [0.0, 1.0, 2.0]
sequences = ["laps"]
"""
    plan = load(tmp_path, GOOD + more)
    jobs = expand(plan)
    assert len(variants(plan, "laps")) == 6 and len(variants(plan, "drone")) == 2
    assert len(jobs) == (6 + 2) * 2 * 2 * 2
    assert {job.source for job in jobs if job.sequence == "drone"} == {f"euroc:{tmp_path}/drone"}
    assert "points:laps,duration_s=6.0,start_s=2.0" in {job.source for job in jobs}
    rows = runs_csv(plan, trials(plan, jobs, {job.key: FAILED for job in jobs})).splitlines()
    assert rows[0].startswith("sequence,delay,start [s],estimator")
    assert any(row.startswith("laps,0.1,2.0,loose") for row in rows)
    assert any(row.startswith("drone,0.1,,loose") for row in rows)
    again = more.replace("[0.0, 1.0, 2.0]", "[3.0]").replace('"laps"', '"drone"')
    assert len(expand(load(tmp_path, GOOD + more + again))) == (6 + 2) * 2 * 2 * 2  # one name, other sequences
    with pytest.raises(UsageError, match=r"two of kind axis are called 'start \[s\]'"):
        load(tmp_path, GOOD + more + more)
    with pytest.raises(UsageError, match=r"axis 'start \[s\]': no sequence 'lap' in laps, drone"):
        load(tmp_path, GOOD + more.replace('"laps"', '"lap"'))


def test_variables_are_replaced_in_the_settings_of_a_sequence(tmp_path):
    text = GOOD.replace('{"frontend.mode" = "mono"}', '{"imu.vibration.recording" = "$ROOT/flight"}')
    (tmp_path / "flight").mkdir()
    table = tmp_path / "flight" / "imu.csv"
    table.write_text("1,2,3\n")
    before = {job.label: job for job in expand(load(tmp_path, text))}
    shaken = before["drone delay=0.0 loose seed 0 member 0"]
    assert shaken.config["imu"]["vibration"]["recording"] == f"{tmp_path}/flight"
    table.write_text("1,2,4\n")
    after = {job.label: job.key for job in expand(load(tmp_path, text))}
    assert {label for label in after if before[label].key != after[label]} == {la for la in after if "drone" in la}


def test_settings_of_estimator_win_over_sequence_over_plan(tmp_path):
    jobs = {job.label: job for job in expand(load(tmp_path, GOOD))}
    tight = jobs["drone delay=0.1 tight seed 3 member 1"].config
    loose = jobs["laps delay=0.0 loose seed 0 member 0"].config
    assert (tight["graph"]["coupling"], loose["graph"]["coupling"]) == ("tight", "loose")
    assert (tight["frontend"]["max_tracks"], loose["frontend"]["max_tracks"]) == (70, 50)
    assert (tight["frontend"]["mode"], loose["frontend"]["mode"]) == ("mono", "auto")
    assert (tight["ekf"]["vision_delay_s"], loose["ekf"]["vision_delay_s"]) == (0.1, 0.0)
    assert (tight["seed"], loose["seed"]) == (3, 0)
    assert loose["map"]["enabled"] is False
    assert loose["view"]["enabled"] is False


def test_members_differ_in_gravity_alone_and_the_first_not_at_all(tmp_path):
    first, second = expand(load(tmp_path, GOOD))[:2]
    assert (first.member, second.member) == (0, 1)
    assert first.config["machine"]["gravity_m_s2"] == 9.81
    assert second.config["machine"]["gravity_m_s2"] == pytest.approx(9.81 * (1 + JITTER), rel=1e-15)
    assert second.config["machine"]["gravity_m_s2"] != 9.81
    second.config["machine"]["gravity_m_s2"] = 9.81
    assert first.config == second.config


def test_estimators_with_one_configuration_share_their_runs(tmp_path):
    text = GOOD.replace('config = {"graph.coupling" = "tight", "frontend.max_tracks" = 70}\n', "")
    text = text.replace('config = {"graph.coupling" = "loose"}\n', "")
    jobs = expand(load(tmp_path, text))
    assert len(list(unique(jobs))) == len(jobs) // 2


def test_an_estimator_may_be_kept_from_sequences_that_it_cannot_be_run_on(tmp_path):
    jobs = expand(load(tmp_path, GOOD.replace('outputs = ["graph"]', 'sequences = ["laps"]')))
    assert {job.sequence for job in jobs if job.estimator == "tight"} == {"laps"}
    assert {job.sequence for job in jobs if job.estimator == "loose"} == {"laps", "drone"}


def test_the_key_follows_data_options_and_configuration(tmp_path):
    (tmp_path / "drone").mkdir()
    table = tmp_path / "drone" / "imu.csv"
    table.write_text("1,2,3\n")
    plan = load(tmp_path, GOOD)
    before = {job.label: job.key for job in expand(plan)}
    assert before == {job.label: job.key for job in expand(plan)}
    table.write_text("1,2,4\n")
    after = {job.label: job.key for job in expand(plan)}
    assert {label for label in before if before[label] != after[label]} == {la for la in before if "drone" in la}
    longer = replace(plan, sequences=(replace(plan.sequences[0], options={"duration_s": 7.0}), plan.sequences[1]))
    changed = {job.label: job.key for job in expand(longer)}
    assert {label for label in after if changed[label] != after[label]} == {la for la in after if "laps" in la}


def test_the_data_counts_and_not_where_they_lie(tmp_path):
    for place in ("here", "there"):
        (tmp_path / place / "drone").mkdir(parents=True)
        (tmp_path / place / "drone" / "imu.csv").write_text("1,2,3\n")
    here, there = (source_identity(f"points:euroc:{tmp_path}/{place}/drone,rig=mono") for place in ("here", "there"))
    assert here == there
    assert here.startswith("points:euroc:")
    assert here.endswith(",rig=mono")
    assert here != source_identity(f"points:euroc:{tmp_path}/here/drone,rig=stereo")
    truths = [source_identity(f"eqvio:gtsam,truth={tmp_path}/{place}/drone,start_s=2") for place in ("here", "there")]
    assert truths[0] == truths[1] and truths[0].endswith(",start_s=2") and str(tmp_path) not in truths[0]
    assert source_identity("sim:handheld-room,duration_s=3") == "sim:handheld-room,duration_s=3"
    assert "missing" in source_identity("euroc:/no/such/folder")
    assert split_source("/bare/path,with=option") == ("", "/bare/path", ",with=option")
    live = ("virtual-cart", "virtual-cart,seed=2", "gy85+webcam", "serial:/dev/ttyUSB0+0")
    for no_file in ("sim:corridor-loop", "points:straight", *live):
        assert recorded_path(no_file) is None
    for source in ("/rides/one", "euroc:/rides/one", "points:euroc:/rides/one,rig=mono", "replay:/rides/one"):
        assert recorded_path(source) == Path("/rides/one")


def test_code_that_only_shows_results_does_not_make_them_new(tmp_path):
    for name in ("cli/eval.py", "slam.py", "report/page.py", "experiment/worker.py", "experiment/page.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("a = 1\n")
    before = code_sha256(tmp_path)
    for name in ("cli/eval.py", "report/page.py", "experiment/page.py"):
        (tmp_path / name).write_text("a = 2\n")
    assert code_sha256(tmp_path) == before
    for name in ("slam.py", "experiment/worker.py"):
        (tmp_path / name).write_text("a = 2\n")
        assert code_sha256(tmp_path) != before
        before = code_sha256(tmp_path)


def test_relative_paths_begin_at_the_plan(tmp_path):
    data = {"name": "p", "sequences": [{"source": "../drone"}], "estimators": [{"name": "e"}]}
    plan = plan_from_data(data, "here", tmp_path / "plans", {})
    assert plan.sequences[0].source == f"{tmp_path}/plans/../drone"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("seeds =", "seed ="), "no field 'seed'; there are: name, sequences"),
        (("options =", "option ="), r"no field 'sequences\[0\]\.option'"),
        (('source = "points:laps"\n', ""), "sequences.0.source: "),
        (("members = 2", "members = 0"), "members must be at least 1"),
        (("members = 2", 'members = "two"'), "members: .* got 'two'"),
        (('outputs = ["graph"]', 'outputs = ["best"]'), "estimators.1.outputs"),
        (('outputs = ["graph"]', "outputs = []"), "estimator 'tight' needs outputs"),
        (('name = "tight"', 'name = "loose"'), "two of kind estimator are called 'loose'"),
        (('outputs = ["graph"]', 'sequences = ["lap"]'), "estimator 'tight': no sequence 'lap' in laps, drone"),
        (("seeds = [0, 3]", "seeds = [3, 3]"), "two of kind seed"),
        (("seeds = [0, 3]", "seeds = []"), "at least one seed"),
        (("values = [0.0, 0.1]", "values = []"), "axis 'delay' needs values"),
        (('setting = "ekf.vision_delay_s"\n', ""), "needs either a setting or an option"),
        (('name = "small"', 'name = "../small"'), "is no name of a plan"),
        (('"graph.coupling" = "tight"', "seed = 4"), "seeds are a list of the plan"),
        (("$ROOT", "$NOWHERE"), "needs the environment variable NOWHERE"),
        (('name = "small"', "name = "), "cannot be read"),
    ],
)
def test_mistakes_in_a_plan_are_named(tmp_path, change, message):
    assert change[0] in GOOD
    with pytest.raises(UsageError, match=message):
        load(tmp_path, GOOD.replace(*change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ekf.vision_delay_s", "ekf.delay"), "no setting 'ekf.delay'"),
        (('"graph.coupling" = "tight"', '"graph.coupling" = "firm"'), "graph.coupling: .* got 'firm'"),
        (('"frontend.max_tracks" = 50', '"seed.x" = 50'), "seed: "),
        (('"frontend.max_tracks" = 50', '"imu.enabled" = true, imu = 3'), "'imu' is both a section and a setting"),
        (('"frontend.max_tracks" = 50', 'imu = 3, "imu.enabled" = true'), "'imu' in 'imu.enabled' is a setting"),
    ],
)
def test_settings_are_checked_before_anything_runs(tmp_path, change, message):
    assert change[0] in GOOD
    with pytest.raises(UsageError, match=message):
        expand(load(tmp_path, GOOD.replace(*change)))


def test_a_missing_plan_is_one_line(tmp_path):
    with pytest.raises(UsageError, match="cannot be read"):
        load_plan(tmp_path / "none.toml")


def some(sources):
    """Of sources that differ in an option's value alone the first, the last and one between."""
    alike = {}
    for source in sorted(sources):
        alike.setdefault(re.sub(r"=[-+.\de]+", "=", source), []).append(source)
    return {group[n] for group in alike.values() for n in (0, len(group) // 2, -1)}


@pytest.mark.parametrize("path", sorted((REPOSITORY / "experiments").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_plans_are_valid(path):
    plan = load_plan(path, {"VISLAM_DATA": "/data"})
    jobs = expand(plan)
    assert plan.name == path.stem
    repeated = plan.members >= 6 or len(plan.seeds) >= 2  # one run of something chaotic says little
    # many starts of one recording are an ensemble of their own; without a camera nothing is drawn by chance
    assert repeated or plan.name in ("starts", "drives")
    assert len({job.label for job in jobs}) == len(jobs) > 0
    for source in some({job.source for job in jobs}):
        scheme, name, options = split_source(source)
        if scheme == "eqvio:":
            open_source(",".join([f"{scheme}{name}", *(part for part in options.split(",") if "_s=" in part)]))
        elif is_world(scheme, name):
            open_source(source, 0)
        elif scheme.startswith("points:"):  # the data are absent here: its options are tried on a world
            open_source(f"points:laps{options}", 0)
