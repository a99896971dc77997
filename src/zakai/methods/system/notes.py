"""Sentences that several methods give with an interval."""

OMITTED = "an increment gathered over more than its interval counts as if dv and dw were independent: cross_noise is omitted"
