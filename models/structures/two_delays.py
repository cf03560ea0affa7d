"""Model with a gain and a dead time for each input, derived from SM: the lag of SM becomes dead time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures.identified import round_values
from diffdrive_mpc.models.structures.model_file import TwoDelaysFile, TwoPoles
from diffdrive_mpc.models.structures.sm import METHOD, identify_sm
from diffdrive_mpc.models.structures.structure import IdentificationConditions, StructureFit
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS

FROM_SM = "; its lag is taken as dead time, and its gain is kept"


def identify(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify the structure two_delays; implements `Structure.identify`."""
    sm = identify_sm(records, yaw=conditions.yaw, limits=conditions.limits)

    def gains_and_delays(row: FloatArray) -> FloatArray:
        value = dict(zip(sm.parameters.names, row, strict=True))
        results = []
        for channel in CHANNELS:
            poles = [value[f"{channel}.{name}"] for name in TwoPoles.model_fields]
            results += [poles[0], value[f"{channel}.dead_time"] + TwoPoles.lag(poles)]
        return np.array(results)

    names = [f"{channel}.{name}" for channel in CHANNELS for name in ("gain", "dead_time")]
    parameters = sm.parameters.derived(names, gains_and_delays)
    content = {
        "dead_time": {channel: round_values(parameters.value(f"{channel}.dead_time")) for channel in CHANNELS},
        "channels": {channel: {"gain": round_values(parameters.value(f"{channel}.gain"))} for channel in CHANNELS},
    }
    method = METHOD.format(TWO_POLES.description) + FROM_SM
    return StructureFit(replace(sm, schema=TwoDelaysFile, content=content, parameters=parameters, method=method))
