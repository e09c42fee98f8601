"""Messages of sweeps."""

from cosim.base.messages import Template

VARIED_TWICE = Template("E-SWP-023", '{entry} and "{other}" of line {line}: both give {place}; vary one of them')
WHOLE_AFTER_PART = Template(
    "E-SWP-024",
    '{entry} and "{other}" of line {line} both set {place}, and the later entry replaces the earlier one; set the '
    "whole first and its part after it",
)
SET_AND_VARIED = Template(
    "E-SWP-025",
    '{entry} and "{other}" of line {line} both set {place}, and the varied value replaces this one; remove this one',
)
ARRAYS_DISAGREE = Template(
    "W-SWP-038",
    "{runs} repeated through the FMUs do not agree: the largest relative difference is {difference}; {allowed} is"
    " allowed",
)
ARRAYS_AGREE = Template(
    "N-SWP-041",
    "{runs} repeated through the FMUs agree: the largest relative difference is {difference}; {allowed} is allowed",
)
ALL_THROUGH_FMUS = Template("N-SWP-042", "every run was made through the FMUs{reason}")
