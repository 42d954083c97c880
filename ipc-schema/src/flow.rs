//! Flow control by credits: a producer may be a bounded number of ticks ahead of its required consumer.

use crate::board::Progress;

/// True if a producer may send `tick` while its consumer stands at `consumer`.
///
/// `window` ticks may be sent and not yet consumed; nothing may be sent to a consumer that is not attached.
#[must_use]
pub fn has_credit(tick: u64, consumer: &Progress, window: u64) -> bool {
    has_credit_at(tick, consumer, consumer.consumed_ticks, window)
}

/// As [`has_credit`] for a consumer that has consumed the ticks of this channel below `consumed_ticks`.
#[must_use]
pub fn has_credit_at(tick: u64, consumer: &Progress, consumed_ticks: u64, window: u64) -> bool {
    consumer.attached == 1 && tick < consumed_ticks.saturating_add(window)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(consumed_ticks: u64, attached: u32) -> Progress {
        Progress {
            consumed_ticks,
            attached,
            ..Progress::default()
        }
    }

    #[test]
    fn nothing_is_sent_before_the_consumer_is_attached() {
        assert!(!has_credit(0, &at(0, 0), 8));
        assert!(has_credit(0, &at(0, 1), 8));
    }

    proptest! {
        /// Whatever the interleaving, at most `window` ticks are in flight and the producer never stops for good.
        #[test]
        fn at_most_a_window_is_in_flight(window in 1_u64..20, choices in prop::collection::vec(any::<bool>(), 1..500)) {
            let (mut sent, mut consumed) = (0_u64, 0_u64);
            for produce in choices {
                if produce && has_credit(sent, &at(consumed, 1), window) {
                    sent += 1;
                } else if consumed < sent {
                    consumed += 1;
                }
                prop_assert!(sent - consumed <= window);
            }
            prop_assert!(has_credit(sent, &at(sent, 1), window));
        }
    }
}
