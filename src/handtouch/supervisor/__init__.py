"""Supervisor process: learns gains and offsets from blocks of samples, and diagnoses pads."""
