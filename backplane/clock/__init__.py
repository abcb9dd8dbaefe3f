"""The common clock: releases, waiting, and what watches whether it runs."""
