"""One live interaction: asynchronous sensors in, forecasts out."""

from torch_ebip.live.filter import LiveFilter, LiveSnapshot
from torch_ebip.live.forecast import SessionForecast
from torch_ebip.live.replaying import Replay, replay
from torch_ebip.live.report import SensorReport, SessionReport
from torch_ebip.live.session import InteractionSession
from torch_ebip.live.settings import SessionSettings

__all__ = [
    "InteractionSession",
    "LiveFilter",
    "LiveSnapshot",
    "Replay",
    "SensorReport",
    "SessionForecast",
    "SessionReport",
    "SessionSettings",
    "replay",
]
