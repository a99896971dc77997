"""Observations in, arrays out: records, CSV and NetCDF files; pure reading, atomic writing."""

from zakai.records.csv import read_record
from zakai.records.input_files import read_inputs
from zakai.records.inputs import Inputs
from zakai.records.netcdf import load_dataset, save_dataset
from zakai.records.record import Record, write_record
from zakai.records.truth import Truth, read_truth, write_truth
from zakai.records.writing import atomic_write

__all__ = [
    "Inputs",
    "Record",
    "Truth",
    "atomic_write",
    "load_dataset",
    "read_inputs",
    "read_record",
    "read_truth",
    "save_dataset",
    "write_record",
    "write_truth",
]
