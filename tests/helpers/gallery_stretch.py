"""A part of a walk through the gallery: references, and queries between them."""

from bench.datasets.gallery import Gallery

WALK = Gallery(views=150, rooms=1, width=320, height=240, detail=0.5)
STRETCH = range(84, 104)  # along one wall of the courtyard
QUERY = 4  # every fourth view is a query
WORDS = 300
REFERENCES = [index for index in range(len(STRETCH)) if index % QUERY != QUERY // 2]  # the other views
