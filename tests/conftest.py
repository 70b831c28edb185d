"""What all tests share: one computing thread each, and random streams of their own."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: tests are many and small
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
