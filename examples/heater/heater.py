"""The twin of a heater: a metal block, heated by a resistor and cooled by the air around it."""

import retwin as rt
from retwin.twins import State, StateTwin

twin = StateTwin(
    states=[State("block", "degC", low=-20.0, high=200.0)],
    output=lambda x, u: (x.block,),  # or (x, u, p)
    inputs=rt.Channels(("heater", "ambient"), ("W", "degC")),
    outputs=rt.Channels(("block",), ("degC",)),
    rate=1.0,
    derivative=lambda x, u, p: ((u.heater - p.loss * (x.block - u.ambient)) / p.capacity,),
    parameters=[
        rt.Parameter("loss", "W/K", low=0.01, high=2.0, start=0.3),
        rt.Parameter("capacity", "J/K", low=1.0, high=200.0, start=40.0),
    ],
)
