"""What a step raises that no grid can hold."""


class Unresolved(ArithmeticError):
    """A density that no grid holds: the substep is too long, or the density was lost."""
