"""What viewers draw: grids of several fields, shapes that can be seen, and the layout's template."""

import json

import numpy as np
import pytest

from tmc.analysis.viewer import layout, messages
from tmc.record import builders
from tmc.record.errors import RecordError


def test_a_grid_of_several_fields_grows_to_the_north_and_comes_back():
    given = {
        "terrain": np.array([0, 1, 2, 3, 4, 255], "u1"),
        "last_visit": np.array([0, 1, 2, 3, 4, 2**32 - 1], "<u4"),
        "uncertainty": np.array([0, 0.1, 0.2, 0.3, 0.4, 1], "<f4"),
    }
    message = builders.layers(given, 2, 3, 60.0, 5)
    assert [(f.name, f.offset, f.type) for f in message.fields] == [
        ("terrain", 0, 1), ("last_visit", 1, 5), ("uncertainty", 5, 7),
    ]  # fmt: skip
    assert (message.cell_stride, message.row_stride, len(message.data)) == (9, 27, 54)
    assert message.data[0] == 3  # the south-west corner comes first
    for name, values in given.items():
        back = builders.layer(message, name)
        assert back.dtype == values.dtype and back.tolist() == values.tolist()
    with pytest.raises(RecordError, match="no field speed: it has terrain, last_visit, uncertainty"):
        builders.layer(message, "speed")
    with pytest.raises(RecordError, match="2 x 2 cells needs 4 values"):
        builders.layers(given, 2, 2, 60.0, 0)


def test_every_shape_has_a_body():
    for shape in range(2 * len(messages.SHAPES)):
        entity = messages.uav_entity(41, [(30.0, 90.0)], "#FF0080", shape, 60.0, 7)
        (body,) = [*entity.spheres, *entity.cubes, *entity.cylinders]
        assert min(body.size.x, body.size.y, body.size.z) > 0
        assert (body.color.r, body.color.g, body.color.a) == (1.0, 0.0, 1.0)
        for cylinder in entity.cylinders:
            assert cylinder.bottom_scale == 1.0
        assert entity.timestamp.ToNanoseconds() == 7 and entity.texts[0].text == "41"


def test_the_layout_is_filled_in_for_each_uav_and_drops_what_is_not_there():
    topics = {"/scene", "/log", "/uav/0/belief", "/uav/1/belief", "/tmc/tick", "/uav/1/tick"}
    made = layout.layout(topics, ["#111111", "#222222"], 30, 20, 60.0)
    assert set(layout.topics_of(made)) == topics
    belief = made["configById"]["3D!belief"]
    assert [belief["topics"][f"/uav/{i}/belief"]["visible"] for i in (0, 1)] == [True, False]
    assert belief["cameraState"]["targetOffset"] == [600.0, 900.0, 0]
    assert belief["cameraState"]["distance"] == pytest.approx(1980.0)
    lines = made["configById"]["Plot!uncertainty"]["paths"]
    assert [(line["value"], line["color"], line["label"]) for line in lines[:-2]] == [
        ("/uav/1/tick.believed_per_cell", "#222222", "map of UAV 1")
    ]
    assert "<" not in json.dumps(made)
