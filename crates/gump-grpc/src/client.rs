//! Calls of nuPlan's planner protocol, with time limits.

use std::time::Duration;

use gump_proto::nuplan::SERVICE;
use prost::Message;
use tokio::runtime::{Builder, Runtime};
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::{Channel, Endpoint};
use tonic_prost::ProstCodec;

use super::RemoteError;

/// Time limit for connecting: a running planner answers at once. Chosen by hand.
const REACH: Duration = Duration::from_secs(5);

/// A connection to one planner.
pub(super) struct Client {
    runtime: Runtime,
    grpc: Grpc<Channel>,
}

impl Client {
    /// Connects to `HOST:PORT`.
    ///
    /// # Errors
    /// [`RemoteError::Unreachable`] if the connection fails or takes more than 5 s.
    pub(super) fn connect(address: &str) -> Result<Self, RemoteError> {
        let unreachable = |error: &dyn std::error::Error| RemoteError::Unreachable {
            address: address.into(),
            what: innermost(error),
        };
        let runtime = Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|error| unreachable(&error))?;
        let endpoint = Endpoint::from_shared(format!("http://{address}"));
        let endpoint = endpoint.map_err(|error| unreachable(&error))?;
        let channel = runtime.block_on(endpoint.connect_timeout(REACH).connect());
        Ok(Self {
            grpc: Grpc::new(channel.map_err(|error| unreachable(&error))?),
            runtime,
        })
    }

    /// Makes one call and returns the answer.
    ///
    /// # Errors
    /// [`RemoteError::Late`] after `limit`, [`RemoteError::Refused`] if the planner
    /// returns an error status or the connection breaks.
    pub(super) fn call<M, R>(
        &mut self,
        call: &'static str,
        message: M,
        limit: Duration,
    ) -> Result<R, RemoteError>
    where
        M: Message + Send + Sync + 'static,
        R: Message + Default + Send + Sync + 'static,
    {
        let path = PathAndQuery::try_from(format!("{SERVICE}/{call}"));
        let path = path.expect("names of calls are letters");
        let grpc = &mut self.grpc;
        let answer = async {
            let gone = |error: tonic::transport::Error| tonic::Status::from_error(error.into());
            grpc.ready().await.map_err(gone)?;
            let request = tonic::Request::new(message);
            grpc.unary(request, path, ProstCodec::default()).await
        };
        let answer = self
            .runtime
            .block_on(async { tokio::time::timeout(limit, answer).await });
        match answer {
            Ok(Ok(answer)) => Ok(answer.into_inner()),
            Ok(Err(status)) => Err(RemoteError::Refused {
                call,
                code: format!("{:?}", status.code()),
                message: one_line(status.message()),
            }),
            Err(_) => Err(RemoteError::Late {
                call,
                seconds: limit.as_secs_f64(),
            }),
        }
    }
}

/// Message of the root cause of an error: outer ones only state where it was noticed.
fn innermost(error: &dyn std::error::Error) -> String {
    let mut error = error;
    while let Some(source) = error.source() {
        error = source;
    }
    one_line(&error.to_string())
}

/// Tracebacks of other processes on one line.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
