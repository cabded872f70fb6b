"""docs/reliability.md is what tools/faults found."""

import json

from tools.faults.__main__ import PAGE, RESULTS, page


def test_the_page_is_as_generated():
    assert PAGE.read_text() == page(json.loads(RESULTS.read_text())), "python -m tools.faults writes it"
