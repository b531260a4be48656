"""The metrics for Prometheus, made from the state of the monitor when they are requested."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from retwin.monitor.live.live import Live

BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper ends of the histogram of latencies in s; the contract is 5 ms in the median, 20 ms at
99 %."""


class Metrics:
    """The metrics of a live monitor.

    Parameters
    ----------
    live : Live
        The monitor.
    sources : mapping of str to callable
        Whether each source of samples is connected, by its name.

    """

    def __init__(self, live: Live, sources: Mapping[str, Callable[[], bool]]) -> None:
        self._live = live
        self._sources = sources
        self._registry = CollectorRegistry()
        self.latency = Histogram(
            "retwin_samples_seconds",
            "Time from the arrival of samples over HTTP until they are durable.",
            registry=self._registry,
            buckets=BUCKETS,
        )
        self._registry.register(self)

    def text(self) -> bytes:
        """All metrics in the text format of Prometheus."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Any]:
        """The metrics of the assets; Prometheus' client calls it."""
        what, labels = "Samples by what was done with them.", ["asset", "result"]
        samples = CounterMetricFamily("retwin_samples", what, labels=labels)
        alarms = CounterMetricFamily("retwin_alarms", "Events since the start.", labels=["asset"])
        gauges = {
            name: GaugeMetricFamily(f"retwin_{name}", text, labels=["asset"])
            for name, text in GAUGES.items()
        }
        for each in self._live.status():
            for result, count in each.counts.items():
                samples.add_metric([each.asset, result], count)
            alarms.add_metric([each.asset], each.alarms)
            gauges["evidence_ratio"].add_metric([each.asset], each.ratio)
            for name in ("event", "void", "outside"):
                gauges[name].add_metric([each.asset], getattr(each, name))
            if each.time is not None:
                gauges["newest_sample_seconds"].add_metric([each.asset], each.time / 1e9)
        what = "Whether a source is connected."
        up = GaugeMetricFamily("retwin_source_up", what, labels=["source"])
        for name, connected in self._sources.items():
            up.add_metric([name], connected())
        yield from (samples, alarms, *gauges.values(), up)


GAUGES = {
    "evidence_ratio": "Evidence for a change divided by the threshold of an alarm.",
    "event": "Whether an event lasts.",
    "void": "Whether the promise does not apply any more.",
    "outside": "Whether commands leave the range of the calibration.",
    "newest_sample_seconds": "Time of the newest sample since the epoch.",
}
