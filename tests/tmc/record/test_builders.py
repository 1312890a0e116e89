"""Messages of the log hold exactly what they were made from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tmc.record import builders, overfly_pb2
from tmc.record.errors import RecordError
from tmc.wire.messages import Record

small = st.integers(0, 65_535)
large = st.integers(0, 2**62)


@st.composite
def records(draw):
    def some(dtype, **options):
        return draw(arrays(dtype, draw(st.integers(0, 12)), **options))

    return Record(
        uav=draw(small), incarnation=draw(large), sequence=draw(large), episode=draw(st.integers(1, 2**31 - 1)),
        first=draw(small), tick=draw(small), version=draw(large), policy=draw(large),
        cells=some("<u2"), actions=some("u1"), blocks=some("u1"),
        rewards=some("<f4", elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
        seen_tick=some("<u2"), seen_cell=some("<u2"),
        values=some("<f4", elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
    )  # fmt: skip


@given(records())
def test_flight_records_come_back_exactly(record):
    data = builders.flight_record(record).SerializeToString()
    back = builders.to_record(overfly_pb2.FlightRecord.FromString(data))
    for name, value in vars(record).items():
        other = getattr(back, name)
        if isinstance(value, np.ndarray):
            assert value.dtype == other.dtype and value.tobytes() == other.tobytes()
        else:
            assert type(value) is type(other) and value == other


@pytest.mark.parametrize("bad", [{"cells": [65_536]}, {"actions": [256]}, {"rewards": [float("nan")]}, {"episode": 0}])
def test_a_flight_record_that_no_uav_may_send_is_refused(bad):
    with pytest.raises(RecordError, match="flight record of UAV 3 is not intact"):
        builders.to_record(overfly_pb2.FlightRecord(**({"uav": 3, "episode": 1} | bad)))


def test_grid_grows_to_the_north_and_comes_back():
    ticks = np.arange(6, dtype=np.uint16) + 65_530
    message = builders.grid(ticks, 2, 3, 60.0, 1_500_000_000)
    assert np.frombuffer(message.data, "<u4").tolist() == [65_533, 65_534, 65_535, 65_530, 65_531, 65_532]
    assert (message.column_count, message.row_stride, message.cell_stride, message.cell_size.x) == (3, 12, 4, 60.0)
    assert message.timestamp.ToNanoseconds() == 1_500_000_000
    assert message.pose.HasField("position") and message.fields[0].name == "last_visit"
    assert builders.last_visit(message).tolist() == ticks.tolist()
    with pytest.raises(RecordError, match="2 x 2 cells needs 4 values"):
        builders.grid(ticks, 2, 2, 60.0, 0)


def test_location_fix():
    fix = builders.location_fix(-79.4, 43.7, 1, frame="uav-3")
    assert (fix.longitude, fix.latitude, fix.frame_id) == (-79.4, 43.7, "uav-3")
