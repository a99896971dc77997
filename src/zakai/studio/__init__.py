"""A local page on which a model is written, a record is filtered, and the density is shown: `zakai studio`."""
