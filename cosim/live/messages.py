"""Messages of the live page."""

from cosim.base.messages import Template

LIVE_PAGE = Template("N-LIV-001", "live page: {url}")
NOT_RUNNING = Template("E-LIV-003", "the {activity} has ended, so that nothing can be changed")
WRONG_REQUEST = Template("E-LIV-004", "is {value}; give {wanted}")
STOPPED = Template("N-LIV-005", "stopped at t = {time:.6g} s; the rows so far are kept")
