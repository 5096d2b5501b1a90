"""One live interaction: asynchronous sensors in, forecasts out."""

from torch_ebip.session.intake import SensorReport
from torch_ebip.session.replaying import Replay, replay
from torch_ebip.session.session import InteractionSession, SessionForecast
from torch_ebip.session.settings import SessionSettings

__all__ = ["InteractionSession", "Replay", "SensorReport", "SessionForecast", "SessionSettings", "replay"]
