"""What is the matter with a pad, told from its counts alone: long contacts and electrical faults.

Public: `DiagnosisModel` and `Block` in, `Finding` (of a `Kind`) out. Pure logic; time comes with the samples.
"""

from handtouch.supervise.diagnose.findings import Block, DiagnosisModel, Finding, Kind

__all__ = ["Block", "DiagnosisModel", "Finding", "Kind"]
