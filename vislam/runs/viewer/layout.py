"""How Rerun arranges its views of a run."""

from typing import Any

import rerun.blueprint as rrb


def layout(camera: str, groups: list[str], has_loop_pictures: bool, eye: Any) -> Any:
    """Return the layout: the world beside the camera, the tracking state and one plot per group of numbers.

    `camera` is the entity that holds the camera's image, `eye` the point of view of the world.
    """
    plots = [rrb.TimeSeriesView(origin=f"plots/{group}", name=group) for group in groups]
    side: list[Any] = [
        rrb.Spatial2DView(origin=camera, name="camera"),
        rrb.StateTimelineView(origin="status", name="tracking"),
    ]
    if plots:
        side.append(rrb.Tabs(*plots))
    if has_loop_pictures:
        pair = rrb.Spatial2DView(origin="loop/pair", name="loop candidate")
        side.append(rrb.Horizontal(pair, rrb.TextDocumentView(origin="loop/why", name="why")))
    side.append(rrb.TextLogView(origin="notes", name="notes"))
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        contents=[
            "$origin/**",
            "- world/loops/rejected",
            f"- {camera}/image/**",
            "- world/octree",
            "- world/grid",
        ],
        background=[20, 22, 26],
        eye_controls=eye,
    )
    solid = rrb.Spatial3DView(
        origin="world",
        name="octree and grid",
        contents=["world/octree", "world/grid", "world/paths/**", "world/live"],
        background=[20, 22, 26],
        eye_controls=eye,
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(world, solid),
            rrb.Vertical(*side, row_shares=[4, 1.2, *[2.5] * (len(side) - 3), 1.5]),
            column_shares=[2.2, 1],
        ),
        rrb.TimePanel(state="collapsed"),
        collapse_panels=True,
    )
