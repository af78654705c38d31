"""What makes a flight impossible, as opposed to a program wrong."""


class InfeasibleFlightError(ValueError):
    """
    This flight cannot be flown, though nothing is wrong with the program.

    Raised where a random world, start or goal does not leave what a flight needs: no instance of
    the world drawn from its seed has a way through, start or goal lie where the vehicle does not
    fit, or no way leads from where the planner is to its goal. Other seeds of the same scenario may
    well be flown, and so a study counts such a flight as failed and goes on; every other exception
    is a mistake in a program or a configuration, and stops it.
    """
