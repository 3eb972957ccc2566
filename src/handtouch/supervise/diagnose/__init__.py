"""What is the matter with a pad, told from its counts alone: long contacts and electrical faults.

Public: `Diagnosis` of a `DiagnosisModel`, which takes `Block`s and has `Finding`s (of a `Kind`). Pure logic;
time comes with the samples.
"""

from handtouch.supervise.diagnose.diagnosis import Diagnosis
from handtouch.supervise.diagnose.findings import Block, DiagnosisModel, Finding, Kind

__all__ = ["Block", "Diagnosis", "DiagnosisModel", "Finding", "Kind"]
