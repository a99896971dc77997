"""What results are checked by: residuals, laws of future observations, comparisons, and the time that a filter will take."""
