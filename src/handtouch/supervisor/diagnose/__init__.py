"""Diagnosis of pads from their counts alone: static loads, electrical faults, torn sheets.

Public: `HandDiagnostics` of a `DiagnosisModel`, which processes `HandSamples` and returns `PadDiagnosis`
objects. Pure logic; time comes with the samples.
"""

from handtouch.supervisor.diagnose.hand_diagnostics import HandDiagnostics
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples, PadDiagnosis

__all__ = ["DiagnosisModel", "HandDiagnostics", "HandSamples", "PadDiagnosis"]
