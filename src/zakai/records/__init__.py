"""Observations in, arrays out: records, CSV and NetCDF files; pure reading, atomic writing."""

from zakai.records.csv import read_record
from zakai.records.inputs import Inputs, read_inputs
from zakai.records.netcdf import load_dataset, save_dataset
from zakai.records.record import Record
from zakai.records.truth import read_truth, write_truth
from zakai.records.writing import atomic_write, write_record

__all__ = [
    "Inputs",
    "Record",
    "atomic_write",
    "load_dataset",
    "read_inputs",
    "read_record",
    "read_truth",
    "save_dataset",
    "write_record",
    "write_truth",
]
