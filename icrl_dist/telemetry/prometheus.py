"""Serves the newest value of every metric of a run to Prometheus."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Gauge
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from icrl_dist.stream.link import LinkError
from icrl_dist.telemetry.alerts import KINDS
from icrl_dist.telemetry.exporter import MetricsServer

if TYPE_CHECKING:
    from icrl_dist.telemetry.metrics import HeldOut


class Exporter:
    """The endpoint ``http://HOST:PORT/metrics``.  Any thread may set values."""

    def __init__(self, endpoint: str, run: str, names: Mapping[str, Mapping[str, str]], stages: Mapping[str, str]) -> None:
        """``names`` and ``stages`` as in ``metrics``.  Raises LinkError if the port is not free."""
        host, _, port = endpoint.rpartition(":")
        registry = CollectorRegistry()
        self._run = run
        self._gauges = {
            (stage, name): Gauge(f"icrl_{stage}_{name}", text, ["run"], registry=registry).labels(run)
            for stage in names
            if stage != "heldout"
            for name, text in {**names[stage], "step": stages[stage].partition("`step` is ")[2]}.items()
        }
        self._heldout = {
            name: Gauge(f"icrl_heldout_{name}", text, ["run", "p", "agent", "version"], registry=registry)
            for name, text in names["heldout"].items()
        }
        self._alerts = Gauge("icrl_alert_active", "alerts that are active, by kind", ["run", "alert"], registry=registry)
        for kind in KINDS:
            self.set_alerts(kind, 0)
        self.read = threading.Event()
        """Set when the values are read."""
        registry.register(_Reading(self.read))
        try:
            self._server = MetricsServer(host.strip("[]"), int(port), registry)
        except OSError as error:
            raise LinkError(
                f"learner.prometheus = {endpoint!r}: cannot listen there ({error.strerror}); free that port or choose another"
            ) from error

    def set(self, stage: str, step: int, values: Mapping[str, float]) -> None:
        for name, value in {**values, "step": step}.items():
            self._gauges[stage, name].set(value)

    def set_alerts(self, kind: str, active: int) -> None:
        """Set how many alerts of a kind are active."""
        self._alerts.labels(self._run, kind).set(active)

    def set_heldout(self, returns: Sequence[HeldOut]) -> None:
        for one in returns:
            for name, value in one.values.items():
                self._heldout[name].labels(self._run, f"{one.p:g}", one.agent, str(one.version)).set(value)

    def close(self) -> None:
        self._server.close()


class _Reading(Collector):
    """Has no metrics; notices that the others are read."""

    def __init__(self, read: threading.Event) -> None:
        self._read = read

    def describe(self) -> Sequence[Metric]:
        return ()

    def collect(self) -> Iterator[Metric]:
        self._read.set()
        return iter(())
