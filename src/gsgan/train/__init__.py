"""The training scheme: one LightningModule, schedules, callbacks."""
