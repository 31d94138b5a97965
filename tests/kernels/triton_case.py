"""The cases of the Triton kernels by name: functions of a device, which raise where something is wrong."""

CASES = {}


def case(function):
    CASES[function.__name__] = function
    return function
