"""What a run says about itself: report.json and report.md, from its recording alone."""
