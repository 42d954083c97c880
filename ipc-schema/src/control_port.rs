//! The ports of the service `control`: the supervisor sends commands, `traffic-bridge` answers. Neither waits for the other.

use iceoryx2::{
    pending_response::PendingResponse,
    port::{client::Client, server::Server},
    prelude::BackpressureStrategy,
};

use crate::{
    control::{Command, ControlReply, ControlRequest, Refusal, RefusalKind, Reply},
    ports::{PortError, refused},
    services::{ControlService, Shm},
    storage::retry_on_full_disk,
};

const NAME: &str = "control";

/// The supervisor's port.
pub struct ControlClient(Client<Shm, ControlRequest, (), ControlReply, ()>);

/// A command that has been sent and not been answered yet.
pub struct Pending(PendingResponse<Shm, ControlRequest, (), ControlReply, ()>);

impl ControlClient {
    /// Creates the supervisor's port of `service`.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn create(service: &ControlService) -> Result<Self, PortError> {
        let create = || {
            service
                .client_builder()
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
        };
        let client = retry_on_full_disk(create).map_err(|e| refused(NAME, "creation of the client")(&e))?;
        Ok(Self(client))
    }

    /// Sends a command.
    ///
    /// # Errors
    /// Too many commands are under way, or `traffic-bridge` is not connected.
    pub fn send(&self, command: &Command) -> Result<Pending, Refusal> {
        let pending = self.0.send_copy(ControlRequest::from(command));
        match pending {
            Ok(pending) if pending.number_of_server_connections() > 0 => Ok(Pending(pending)),
            Ok(_) => Err(Refusal::new(
                RefusalKind::Unanswered,
                "the simulation does not take commands now: it is starting, or over",
            )),
            Err(error) => Err(Refusal::new(
                RefusalKind::Busy,
                format!("too many commands at a time ({error:?}): send it again"),
            )),
        }
    }
}

impl Pending {
    /// The answer, if it has arrived.
    ///
    /// # Errors
    /// The port is broken.
    pub fn reply(&self) -> Result<Option<Reply>, PortError> {
        let response = self.0.receive().map_err(|e| refused(NAME, "receiving")(&e))?;
        Ok(response.map(|response| Reply::from(response.payload())))
    }
}

/// The port of `traffic-bridge`.
pub struct ControlServer(Server<Shm, ControlRequest, (), ControlReply, ()>);

impl ControlServer {
    /// Creates the port of `traffic-bridge` of `service`.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn create(service: &ControlService) -> Result<Self, PortError> {
        let create = || {
            service
                .server_builder()
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
        };
        let server = retry_on_full_disk(create).map_err(|e| refused(NAME, "creation of the server")(&e))?;
        Ok(Self(server))
    }

    /// Takes the next command and sends the result of `answer`. False if no command waits. A closed connection is ignored.
    ///
    /// # Errors
    /// The port is broken, or `answer` fails.
    pub fn serve<E: From<PortError>>(
        &self,
        answer: impl FnOnce(Result<Command, Refusal>) -> Result<Reply, E>,
    ) -> Result<bool, E> {
        let Some(request) = self.0.receive().map_err(|e| refused(NAME, "receiving")(&e))? else {
            return Ok(false);
        };
        let reply = answer(Command::try_from(request.payload()))?;
        if let Err(error) = request.send_copy(ControlReply::from(&reply)) {
            tracing::debug!(?error, "the connection was closed before the answer to its command");
        }
        Ok(true)
    }
}
